"""Success rates with their intervals."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.setting_rows import lay_out
from benchnav.viz.figure import Figure
from benchnav.viz.panels import draw_interval
from benchnav.viz.style import BLIND, legend_outside, planner_colours

_BAND_ALPHA = 0.12  # opacity of a band
_POINT: dict[str, Any] = {"marker": "o", "ms": 4, "ls": "none", "color": "0.2"}


class Success(Figure):
    """Success rate of each condition with its 95 % interval, one panel per block."""

    name = "success"
    text = (
        "Success rates (points) with 95 % intervals (lines). Filled points are not "
        "significantly worse than the best setting of their panel; all points are open "
        "if no setting is significantly worse. Blind planners are grey: a dashed line "
        "and a grey band extend their rate and its 95 % interval through the panel."
    )

    def draw(self, data: RunData) -> Drawing:
        """Draw a point for each condition, and lines for blind planners."""
        handles = _handles(data.summary)
        legend_in = 0.15 * len(handles)
        figure, panels = lay_out(data.summary, ["success [%]"], legend_in)
        colours = planner_colours(list(data.summary["planner"]))
        for panel, rows in panels:
            for row in rows.to_dict("records"):
                _draw_rate(panel, row, colours[row["planner"]])
        panel.set(xticks=np.arange(0, 101, 25), xlim=(-4, 104))
        if handles:
            legend_outside(figure, handles, 2)
        return figure


def _handles(summary: pd.DataFrame) -> list[Artist]:
    """Return the entries of the legend for the drawn points and lines."""
    # A planner is blind if it uses no model. The model `clairvoyant` has no risk
    # setting either, so the risk label does not show which planners are blind.
    is_blind = summary["model"] == NOT_USED
    unmarked = pd.Series(False, summary.index)
    marks = summary.get("best_marked", unmarked)
    is_marked = marks.fillna(False).astype(bool)
    handles: list[Artist] = []
    if is_marked.any():
        words = "not significantly worse than the best"
        handles.append(Line2D([], [], **_POINT, label=words))
        if not is_marked.all():
            words = "significantly worse, or a baseline"
            handles.append(Line2D([], [], **_POINT, mfc="white", label=words))
    if is_blind.any():
        line: dict[str, Any] = {"lw": 0.8, "ls": "--"}
        handles.append(Line2D([], [], color=BLIND, label="blind planner", **line))
        words = "its 95 % interval"
        handles.append(Patch(color=BLIND, alpha=_BAND_ALPHA, lw=0, label=words))
    return handles


def _draw_rate(panel: Axes, row: Mapping[Any, Any], planner_colour: str) -> None:
    """Draw a success rate with its interval, through the panel for a blind planner."""
    blind = row["model"] == NOT_USED
    colour = BLIND if blind else planner_colour
    face = colour if row.get("best_marked") else "white"
    height = row["height"]
    rate = 100 * row["success_rate"]
    low = 100 * row["success_low"]
    high = 100 * row["success_high"]
    draw_interval(panel, low, high, height, colour)
    panel.plot(rate, height, "o", color=colour, ms=4, mfc=face)
    if blind:
        panel.axvline(rate, color=colour, lw=0.8, ls="--", zorder=0)
        panel.axvspan(low, high, color=colour, alpha=_BAND_ALPHA, lw=0, zorder=0)
