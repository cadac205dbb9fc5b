"""Waterfall of regret: change of success and time in each step of a chain."""

from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchnav.eval.figures.data import RunData
from benchnav.eval.stats.best import BLOCK
from benchnav.eval.words import joined
from benchnav.stats.tables import signed, signed_interval
from benchnav.viz.figure import Figure
from benchnav.viz.panels import GRID, draw_interval
from benchnav.viz.style import (
    BLUE,
    ORANGE,
    TEXT,
    TWO_COLUMNS_IN,
    legend_outside,
    planner_name,
    risk_name,
)

MAX_CHAINS = 6
_ROW_IN = 0.24
_ENDS = "0.75"
_BOUND = "0.25"
# Axis label, factor, and whether more is worse, for each measure.
_MEASURES = {
    "success": ("success [%]", 100.0, False),
    "time": ("T_total [s]", 1.0, True),
}


class Regret(Figure):
    """A waterfall of paired differences, from a planner to the near-optimal reference."""

    name = "regret"

    def needs(self, data: RunData) -> bool:
        """Return whether the run has a chain of conditions."""
        return not data.regret.empty

    def caption(self, data: RunData) -> str:
        """Return the meaning of a step, and how many chains are shown."""
        chains = data.regret["chain"].nunique()
        shown = ""
        if chains > MAX_CHAINS:
            shown = f" The first {MAX_CHAINS} of {chains} chains are shown."
        return (
            "Regret against the near-optimal reference, which plans on λ itself and is "
            "no bound: paired differences in each step from a planner to the "
            "reference, on common episodes. Black lines are 95 % intervals, the dashed "
            "line is a lower bound. A step may be negative, and another order of steps "
            f"would give other values, so that no step is a cause.{shown}"
        )

    def draw(self, data: RunData) -> Drawing:
        """Draw each chain from its planner (top) to the reference: success, T_total."""
        chains = [rows for _, rows in data.regret.groupby("chain", sort=True)][
            :MAX_CHAINS
        ]
        steps = 2 + max(len(rows) for rows in chains)
        height = len(chains) * (_ROW_IN * steps + 0.55) + 0.3
        figure = Drawing(figsize=(TWO_COLUMNS_IN, height), layout="constrained")
        axes = figure.subplots(
            len(chains), len(_MEASURES), squeeze=False, sharey="row", sharex="col"
        )
        differing = [name for name in BLOCK if data.regret[name].nunique() > 1]
        for line, rows in zip(axes, chains, strict=True):
            for panel, measure in zip(line, _MEASURES, strict=True):
                _draw_chain(panel, rows, measure)
            names = _row_names(rows)
            line[0].set_yticks(range(len(names)), names)
            line[0].set_ylim(len(rows) + 1.6, -0.6)
            first = rows.iloc[0]
            title = joined(
                [risk_name(first["risk"]), *(first[name] for name in differing)]
            )
            line[0].set_title(f"{title}, {first['n_maps']} maps", loc="left")
        for panel, (label, *_) in zip(axes[-1], _MEASURES.values(), strict=True):
            panel.set_xlabel(label)
            panel.set_xlim(left=0)
        handles: list[Artist] = [
            Patch(color=ORANGE, label="the next is better"),
            Patch(color=BLUE, label="the next is worse"),
            Patch(color=_ENDS, label="of the first, of the near-optimal reference"),
        ]
        if data.regret["time_bound"].notna().any():
            handles.append(
                Line2D(
                    [],
                    [],
                    color=_BOUND,
                    ls="--",
                    lw=1.1,
                    label="lower bound: no planner is better",
                )
            )
        legend_outside(figure, handles, len(handles))
        return figure


def _row_names(rows: pd.DataFrame) -> list[str]:
    """Name the first condition of a chain, the change of each step, and the last."""
    ends = [("one", rows.iloc[0]), *(("other", row) for _, row in rows.iterrows())]
    named = [
        (planner_name(row[f"{end}_planner"]), row[f"{end}_model"]) for end, row in ends
    ]
    steps = [
        "\n".join(
            f"{first} → {then}"
            for first, then in zip(*pair, strict=True)
            if first != then
        )
        for pair in pairwise(named)
    ]
    return [", ".join(named[0]), *steps, ", ".join(named[-1])]


def _draw_chain(panel: Axes, rows: pd.DataFrame, measure: str) -> None:
    """Draw bars of the first and last mean, and the differences between them."""
    _, factor, more_is_worse = _MEASURES[measure]
    means = factor * np.array(
        [*rows[f"{measure}_one"], rows[f"{measure}_other"].iloc[-1]]
    )
    looks: dict[str, Any] = {"height": 0.7, "lw": 0}
    axes_and_data = panel.get_yaxis_transform()
    for height, value in ((0, means[0]), (len(rows) + 1, means[-1])):
        panel.barh(height, value, color=_ENDS, **looks)
        panel.text(
            1.02,
            height,
            f"{value:.1f}",
            transform=axes_and_data,
            va="center",
            size=TEXT,
        )
    for height, row in enumerate(rows.to_dict("records"), start=1):
        difference, low, high = (
            factor * row[f"{measure}_{end}"] for end in ("difference", "low", "high")
        )
        start = means[height - 1]
        end = means[height]
        better = difference > 0 if more_is_worse else difference < 0
        panel.barh(
            height, end - start, left=start, color=ORANGE if better else BLUE, **looks
        )
        from_x, to_x = np.clip(
            [start - high, start - low], 0, None if more_is_worse else factor
        )
        draw_interval(panel, from_x, to_x, height, "black", 0.9)
        words = signed(-difference)
        if low == low:  # few maps have no interval
            words += f" ({signed_interval(-high, -low)})"
        panel.text(
            1.02,
            height,
            words.replace("-", "−"),
            transform=axes_and_data,
            va="center",
            size=TEXT,
        )
    for height, value in enumerate(means):
        panel.plot([value, value], [height - 0.35, height + 1.35], color="0.5", lw=0.5)
    bound = factor * rows[f"{measure}_bound"].iloc[0]
    if bound == bound:
        panel.axvline(bound, color=_BOUND, ls="--", lw=1.1)
    panel.grid(axis="x", color=GRID)
    panel.set_axisbelow(True)
    panel.use_sticky_edges = False
    panel.tick_params(axis="y", length=0)
