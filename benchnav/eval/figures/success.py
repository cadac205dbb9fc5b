"""Success rates with their intervals."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.setting_rows import lay_out
from benchnav.viz.figure import Figure
from benchnav.viz.panels import draw_interval
from benchnav.viz.style import BLIND, legend_outside, planner_colours

_BAND = 0.12  # opacity
_POINT: dict[str, Any] = {"marker": "o", "ms": 4, "ls": "none", "color": "0.2"}


class Success(Figure):
    """The success rate of every condition with its 95 % interval, a panel a block of
    the run.
    """

    name = "success"
    text = (
        "Success rates with 95 % intervals. Filled points are not significantly worse "
        "than the best of their "
        "panel; all are open where nothing is significantly worse. Grey planners are "
        "blind: the dashed line and "
        "the band carry their rate and its interval through the panel."
    )

    def draw(self, data: RunData) -> Drawing:
        """Draw a point a condition; a blind planner is a line through its panel, the
        baseline of all others.
        """
        # the clairvoyant has a model, and no risk
        is_blind = data.summary["model"] == NOT_USED
        is_marked = (
            data.summary.get("best_marked", pd.Series(False, data.summary.index))
            .fillna(False)
            .astype(bool)
        )
        handles: list[Any] = []
        if is_marked.any():
            handles.append(
                Line2D([], [], **_POINT, label="not significantly worse than the best")
            )
            if not is_marked.all():
                handles.append(
                    Line2D(
                        [],
                        [],
                        **_POINT,
                        mfc="white",
                        label="significantly worse, or a baseline",
                    )
                )
        if is_blind.any():
            handles.append(
                Line2D([], [], color=BLIND, lw=0.8, ls="--", label="blind planner")
            )
            handles.append(
                Patch(color=BLIND, alpha=_BAND, lw=0, label="its 95 % interval")
            )
        figure, panels = lay_out(
            data.summary, ["success [%]"], legend_in=0.15 * len(handles)
        )
        colours = planner_colours(list(data.summary["planner"]))
        for panel, rows in panels:
            for row in rows.to_dict("records"):
                blind = row["model"] == NOT_USED
                colour = BLIND if blind else colours[row["planner"]]
                face = colour if row.get("best_marked") else "white"
                rate, low, high = (
                    100 * row[f"success_{name}"] for name in ("rate", "low", "high")
                )
                draw_interval(panel, low, high, row["height"], colour)
                panel.plot(rate, row["height"], "o", color=colour, ms=4, mfc=face)
                if blind:
                    panel.axvline(rate, color=colour, lw=0.8, ls="--", zorder=0)
                    panel.axvspan(low, high, color=colour, alpha=_BAND, lw=0, zorder=0)
        panel.set(xticks=np.arange(0, 101, 25), xlim=(-4, 104))
        if handles:
            legend_outside(figure, handles, 2)
        return figure
