"""How well λ is known ahead of robots that learn, over the time since they set out."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from matplotlib.figure import Figure as Drawing

from benchnav.eval.figures.data import RunData
from benchnav.eval.folder.steps import AHEAD_COLUMNS, AHEAD_DEG, AHEAD_M, step_files
from benchnav.eval.stats.best import BLOCK
from benchnav.eval.words import NAMING, joined, reading_name
from benchnav.stats.bootstrap import LEAST_MAPS, bootstrap_counts
from benchnav.viz.figure import Figure
from benchnav.viz.panels import Curves, line_looks
from benchnav.viz.style import TWO_COLUMNS_IN, legend_outside

# Of each column what its panels are called, and which way is better.
METRICS = dict(
    zip(
        AHEAD_COLUMNS,
        ("RMSE of E[λ] ahead\n(lower is better)", "log score ahead\n(higher is better)"),
        strict=True,
    )
)
_BIN_S = 2.0
_MAX_LINES, _MAX_ACROSS = 7, 4
_LETTER_IN = 0.055
_EPISODE = ["condition", "seed", "realisation", "map"]


class Learning(Figure):
    """RMSE and log score of what is believed ahead of robots, over the seconds of experience."""

    name = "learning"
    text = (
        f"What robots know of the terrain ahead of them, within {AHEAD_M:g} m and {AHEAD_DEG:g}° to either side, "
        "where they have not sensed λ: RMSE of E[λ] and mean log score of the belief, over the time since they set "
        f"out. Means over the maps on which a robot still drives, one for every {_BIN_S:g} s, with 95 % intervals "
        f"(bootstrap over maps). Times with fewer than {LEAST_MAPS} maps are left out."
    )

    curves = pd.DataFrame()

    def variants(self, data: RunData) -> Sequence[Self]:
        """Return one figure where robots learnt, steps were kept, and there are enough maps."""
        curves = read_learning(data.folder, data.episodes) if data.folder else self.curves
        return [self.variant(curves=curves)] if len(curves) else []

    def draw(self, data: RunData) -> Drawing:
        """Draw a line a condition, with its band; where these are many, a panel a model, planner and risk setting."""
        return draw_learning(self.curves, data.summary)


def read_learning(folder: Path, episodes: pd.DataFrame) -> pd.DataFrame:
    """Read how well λ was known ahead of the robots of a run, over the time since they set out.

    Args:
        folder: a finished run.
        episodes: its rows.

    Returns:
        A row a condition and bin of time that at least `LEAST_MAPS` maps, or groups of maps, tell of: `condition`,
        `time_s`, the middle of the bin, `maps`, how many these are, and of each of `METRICS` its mean over them, with
        its 95 % interval in the columns that end in `_low` and `_high`. No row where no robot learnt, or no steps were
        kept.
    """
    names = list(METRICS)
    columns = [
        "condition",
        "time_s",
        "maps",
        *(f"{name}{end}" for name in names for end in ("", "_low", "_high")),
    ]
    known = [
        rows.loc[rows[names[0]].notna(), [*_EPISODE, "time_s", *names]]
        for rows in step_files(folder)
        if names[0] in rows
    ]
    if not known:
        return pd.DataFrame(columns=columns)
    steps = pd.concat(known).merge(episodes[[*_EPISODE, "group"]], on=_EPISODE)
    steps["bin"] = (steps["time_s"] / _BIN_S + 1e-6).astype(int)
    # An episode counts once in a bin, and a map once, however many episodes were on it.
    once = steps.groupby([*_EPISODE, "group", "bin"])[names].mean()
    by_map = once.groupby(["condition", "bin", "group"])[names].mean()
    rows = []
    for (condition, place), own in by_map.groupby(["condition", "bin"]):
        if len(own) < LEAST_MAPS:
            continue
        values = own.to_numpy(np.float64)
        low, high = np.quantile(bootstrap_counts(len(own)) @ values / len(own), [0.025, 0.975], axis=0)
        numbers = np.stack((values.mean(axis=0), low, high), axis=1).ravel()
        rows.append((condition, (place + 0.5) * _BIN_S, len(own), *numbers))
    return pd.DataFrame(rows, columns=columns)


def draw_learning(curves: pd.DataFrame, summary: pd.DataFrame) -> Drawing:
    """Draw curves of `read_learning`, one row or more, as `Learning` does.

    Args:
        curves: the curves.
        summary: of the run, which holds the labels of conditions.
    """
    rows = summary[summary["condition"].isin(curves["condition"])].reset_index(drop=True)
    groups, names = _share_out(rows)
    letters = int((TWO_COLUMNS_IN / min(len(groups), _MAX_ACROSS) - 0.4) / _LETTER_IN)
    points = [
        curves[curves["condition"] == rows["condition"][index]].assign(
            panel=textwrap.fill(title, letters), line=names[index]
        )
        for title, shown in groups
        for index in shown
    ]
    table = pd.concat(points).rename(columns={"time_s": "x"})
    looks = line_looks(names, dashed=True)
    figure, panels = Curves(
        table=table, measures=METRICS, looks=looks, x_label="seconds of experience"
    ).draw()
    next(iter(panels.values())).set_xlim(left=0)
    legend_outside(figure)
    return figure


def _share_out(rows: pd.DataFrame) -> tuple[list[tuple[str, list[int]]], list[str]]:
    """Return titles and conditions of panels, and what each condition is called in all of them.

    Panels are split until none holds more lines than a reader can distinguish.

    Args:
        rows: a condition each, numbered from 0.
    """
    differing = [
        name for name in dict.fromkeys((*BLOCK, *NAMING)) if name in rows and rows[name].nunique() > 1
    ]
    for apart in (
        BLOCK,
        (*BLOCK, "model"),
        (*BLOCK, "model", "planner"),
        (*BLOCK, "model", "planner", "risk"),
    ):
        titled = [name for name in differing if name in apart]
        groups = list(rows.groupby(titled, sort=False)) if titled else [((), rows)]
        if max(len(own) for _, own in groups) <= _MAX_LINES:
            break
    named = [name for name in differing if name not in titled]

    def words(columns: Sequence[str], row: Any) -> str:
        return joined(reading_name(name, row[name]) for name in columns)

    names = [words(named, row) or "mean over maps" for row in rows.to_dict("records")]
    return [(words(titled, own.iloc[0]), own.index.tolist()) for _, own in groups], names
