"""Waterfall of regret: changes of success and T_total in each step of a chain."""

from collections.abc import Sequence
from itertools import pairwise, starmap
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
_ROW_IN = 0.24  # height of a row in inches
_GREY = "0.75"  # colour of the first and the last bar
_BOUND: dict[str, Any] = {"color": "0.25", "ls": "--", "lw": 1.1}
_BAR: dict[str, Any] = {"height": 0.7, "lw": 0}
# Axis label, factor, and whether a higher value is worse, for each measure.
_MEASURES = {
    "success": ("success [%]", 100.0, False),
    "time": ("T_total [s]", 1.0, True),
}


class Regret(Figure):
    """A waterfall of paired differences, from a planner to the near-optimal reference."""

    name = "regret"

    def is_available(self, data: RunData) -> bool:
        """Return whether the run has a chain of conditions."""
        return not data.regret.empty

    def caption(self, data: RunData) -> str:
        """Return a caption that explains steps, lines and the choice of chains."""
        chains = data.regret["chain"].nunique()
        sentences = [
            "Regret against the near-optimal reference, which plans on λ itself but is "
            "not a bound: paired differences in each step from a planner to the "
            "reference, on common episodes.",
            "Black lines are 95 % intervals.",
        ]
        if data.regret["time_bound"].notna().any():
            sentences.append(
                "The dashed line is a lower bound of T_total, and an upper bound of success."
            )
        sentences.append(
            "Steps are not causes: a step may be negative, and another order of steps "
            "would give other values."
        )
        if chains > MAX_CHAINS:
            sentences.append(f"The first {MAX_CHAINS} of {chains} chains are shown.")
        return " ".join(sentences)

    def draw(self, data: RunData) -> Drawing:
        """Draw each chain from the planner (top) to the reference (bottom)."""
        chains = [rows for _, rows in data.regret.groupby("chain", sort=True)]
        chains = chains[:MAX_CHAINS]
        n_rows = 2 + max(len(rows) for rows in chains)
        height = len(chains) * (_ROW_IN * n_rows + 0.55) + 0.3
        figure = Drawing(figsize=(TWO_COLUMNS_IN, height), layout="constrained")
        shared: dict[str, Any] = {"sharey": "row", "sharex": "col"}
        axes = figure.subplots(len(chains), len(_MEASURES), squeeze=False, **shared)
        differing = [name for name in BLOCK if data.regret[name].nunique() > 1]
        for line, rows in zip(axes, chains, strict=True):
            for panel, measure in zip(line, _MEASURES, strict=True):
                _draw_chain(panel, rows, measure)
            names = _row_names(rows)
            line[0].set_yticks(range(len(names)), names)
            line[0].set_ylim(len(rows) + 1.6, -0.6)
            first = rows.iloc[0]
            labels = [risk_name(first["risk"]), *first[differing]]
            title = f"{joined(labels)}, {first['n_maps']} maps"
            line[0].set_title(title, loc="left")
        for panel, (label, *_) in zip(axes[-1], _MEASURES.values(), strict=True):
            panel.set_xlabel(label)
            panel.set_xlim(left=0)
        handles: list[Artist] = [
            Patch(color=_GREY, label="first planner, reference"),
            Patch(color=ORANGE, label="the step improves"),
            Patch(color=BLUE, label="the step worsens"),
        ]
        if data.regret["time_bound"].notna().any():
            words = "bound: no planner is better"
            handles.append(Line2D([], [], label=words, **_BOUND))
        legend_outside(figure, handles, len(handles))
        return figure


def _row_names(rows: pd.DataFrame) -> list[str]:
    """Return names of rows: first condition, changes in each step, last condition."""
    planners = [rows["one_planner"].iloc[0], *rows["other_planner"]]
    models = [rows["one_model"].iloc[0], *rows["other_model"]]
    conditions = list(zip(map(planner_name, planners), models, strict=True))
    first, *_, last = conditions
    return [", ".join(first), *starmap(_change, pairwise(conditions)), ", ".join(last)]


def _change(before: Sequence[str], after: Sequence[str]) -> str:
    """Return the changed labels of a step, one line per label."""
    pairs = zip(before, after, strict=True)
    return "\n".join(f"{old} → {new}" for old, new in pairs if old != new)


def _draw_chain(panel: Axes, rows: pd.DataFrame, measure: str) -> None:
    """Draw bars for the first and the last mean, and for the difference in each step."""
    _, factor, more_is_worse = _MEASURES[measure]
    last_mean = rows[f"{measure}_other"].iloc[-1]
    means = factor * np.array([*rows[f"{measure}_one"], last_mean])
    for height, value in ((0, means[0]), (len(rows) + 1, means[-1])):
        panel.barh(height, value, color=_GREY, **_BAR)
        _write(panel, height, f"{value:.1f}")
    for height, row in enumerate(rows.to_dict("records"), start=1):
        difference = factor * row[f"{measure}_difference"]
        low = factor * row[f"{measure}_low"]
        high = factor * row[f"{measure}_high"]
        start = means[height - 1]
        width = means[height] - start
        improves = difference > 0 if more_is_worse else difference < 0
        colour = ORANGE if improves else BLUE
        panel.barh(height, width, left=start, color=colour, **_BAR)
        maximum = None if more_is_worse else factor
        from_x, to_x = np.clip([start - high, start - low], 0, maximum)
        draw_interval(panel, from_x, to_x, height, "black", 0.9)
        words = signed(-difference)
        if not np.isnan(low):  # with few maps, there is no interval
            words += f" ({signed_interval(-high, -low)})"
        _write(panel, height, words.replace("-", "−"))
    for height, value in enumerate(means):
        panel.plot([value, value], [height - 0.35, height + 1.35], color="0.5", lw=0.5)
    bound = factor * rows[f"{measure}_bound"].iloc[0]
    if not np.isnan(bound):
        panel.axvline(bound, **_BOUND)
    panel.grid(axis="x", color=GRID)
    panel.set_axisbelow(True)
    panel.use_sticky_edges = False
    panel.tick_params(axis="y", length=0)


def _write(panel: Axes, height: float, words: str) -> None:
    """Write a value to the right of a panel."""
    side = panel.get_yaxis_transform()
    panel.text(1.02, height, words, transform=side, va="center", size=TEXT)
