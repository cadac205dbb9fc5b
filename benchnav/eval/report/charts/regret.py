"""The waterfall of regret: what each step of a chain of conditions takes from success, and adds to time."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchnav.core.figures import (
    BLUE,
    ORANGE,
    TEXT,
    TWO_COLUMNS_IN,
    legend_outside,
    planner_name,
    risk_name,
    styled,
)
from benchnav.eval.report.words import joined
from benchnav.eval.stats.best import BLOCK

MOST_CHAINS = 6
_ROW_IN = 0.24
_ENDS = "0.75"
_BOUND = "0.25"
# Of each measure its axis, its factor, and whether more is worse.
_MEASURES = {"success": ("success [%]", 100.0, False), "time": ("T_total [s]", 1.0, True)}


@styled()
def regret_figure(table: pd.DataFrame) -> Figure:
    """Draws each chain from its planner, on top, to the near-optimal reference: success left, T_total right.

    Args:
        table: from `regret.split_regret`, at least one row; at most `MOST_CHAINS` chains are drawn, the first.
    """
    chains = [rows for _, rows in table.groupby("chain", sort=True)][:MOST_CHAINS]
    steps = 2 + max(len(rows) for rows in chains)
    figure = Figure(
        figsize=(TWO_COLUMNS_IN, len(chains) * (_ROW_IN * steps + 0.55) + 0.3), layout="constrained"
    )
    axes = figure.subplots(len(chains), len(_MEASURES), squeeze=False, sharey="row", sharex="col")
    differing = [name for name in BLOCK if table[name].nunique() > 1]
    for line, rows in zip(axes, chains, strict=True):
        for panel, measure in zip(line, _MEASURES, strict=True):
            _draw_chain(panel, rows, measure)
        told = rows.to_dict("records")
        first, last = _named(told[0], "one"), _named(told[-1], "other")
        names = [", ".join(first), *map(_step_name, told), ", ".join(last)]
        line[0].set_yticks(range(len(names)), names)
        line[0].set_ylim(len(rows) + 1.6, -0.6)
        about = rows.iloc[0]
        title = joined([risk_name(about["risk"]), *(about[name] for name in differing)])
        line[0].set_title(f"{title}, {about['n_maps']} maps", loc="left")
    for panel, (label, *_) in zip(axes[-1], _MEASURES.values(), strict=True):
        panel.set_xlabel(label)
        panel.set_xlim(left=0)
    handles: list[Artist] = [
        Patch(color=ORANGE, label="the next is better"),
        Patch(color=BLUE, label="the next is worse"),
        Patch(color=_ENDS, label="of the first, of the near-optimal reference"),
    ]
    if table["time_bound"].notna().any():
        handles.append(
            Line2D([], [], color=_BOUND, ls="--", lw=1.1, label="lower bound: no planner is better")
        )
    legend_outside(figure, handles, len(handles))
    return figure


def _named(row: Mapping[Any, Any], end: str) -> tuple[str, str]:
    """Planner and model of an end of a step, as they are read."""
    return planner_name(row[f"{end}_planner"]), row[f"{end}_model"]


def _step_name(row: Mapping[Any, Any]) -> str:
    """What changes from one condition to the next, of planner and model."""
    pairs = zip(_named(row, "one"), _named(row, "other"), strict=True)
    return "\n".join(f"{first} → {then}" for first, then in pairs if first != then)


def _draw_chain(panel: Axes, rows: pd.DataFrame, measure: str) -> None:
    """Bars of the first and the last mean, and between them each difference from where the one before ended."""
    _, factor, more_is_worse = _MEASURES[measure]
    means = factor * np.array([*rows[f"{measure}_one"], rows[f"{measure}_other"].iloc[-1]])
    looks: dict[str, Any] = {"height": 0.7, "lw": 0}
    beside = panel.get_yaxis_transform()
    for place, value in ((0, means[0]), (len(rows) + 1, means[-1])):
        panel.barh(place, value, color=_ENDS, **looks)
        panel.text(1.02, place, f"{value:.1f}", transform=beside, va="center", size=TEXT)
    for place, row in enumerate(rows.to_dict("records"), start=1):
        difference, low, high = (factor * row[f"{measure}_{end}"] for end in ("difference", "low", "high"))
        start, end = means[place - 1], means[place]
        better = difference > 0 if more_is_worse else difference < 0
        panel.barh(place, end - start, left=start, color=ORANGE if better else BLUE, **looks)
        ends = np.clip([start - high, start - low], 0, None if more_is_worse else factor)
        panel.plot(ends, [place, place], color="black", lw=0.9)
        words = _signed(-difference)
        if low == low:  # of few maps there is no interval
            words += f" ({_signed(-high)} to {_signed(-low)})"
        panel.text(1.02, place, words, transform=beside, va="center", size=TEXT)
    for place, value in enumerate(means):
        panel.plot([value, value], [place - 0.35, place + 1.35], color="0.5", lw=0.5)
    bound = factor * rows[f"{measure}_bound"].iloc[0]
    if bound == bound:
        panel.axvline(bound, color=_BOUND, ls="--", lw=1.1)
    panel.grid(axis="x", color="0.93")
    panel.set_axisbelow(True)
    panel.use_sticky_edges = False
    panel.tick_params(axis="y", length=0)


def _signed(value: float) -> str:
    """A difference with its sign and one decimal; 0 has none."""
    return f"{value:+.1f}".replace("-", "−") if abs(value) >= 0.05 else "0.0"
