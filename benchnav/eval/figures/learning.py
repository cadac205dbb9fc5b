"""Accuracy of the belief ahead of robots that learn, over the episode's time."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
import pandas as pd
from matplotlib.figure import Figure as Drawing

from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.lines import MAX_ACROSS, divide_lines
from benchnav.eval.folder.steps import AHEAD_COLUMNS, AHEAD_DEG, AHEAD_M, step_files
from benchnav.eval.stats.best import BLOCK
from benchnav.eval.words import NAMING, joined, reading_name
from benchnav.stats.bootstrap import LEAST_MAPS, bootstrap_counts
from benchnav.viz.figure import Figure
from benchnav.viz.panels import Curves, line_looks
from benchnav.viz.style import TWO_COLUMNS_IN, legend_outside

# Title of each column's panels, with the better direction.
METRICS = dict(
    zip(
        AHEAD_COLUMNS,
        (
            "RMSE of E[λ] ahead\n(lower is better)",
            "log score ahead\n(higher is better)",
        ),
        strict=True,
    )
)
_BIN_S = 2.0
_PANEL_COLUMNS = ((), ("model",), ("planner", "model"), ("planner", "risk", "model"))
_LETTER_IN = 0.055
_EPISODE = ["condition", "seed", "realisation", "map"]


class Learning(Figure):
    """RMSE and log score of the belief ahead of robots, over seconds of experience."""

    name = "learning"
    text = (
        f"Belief of robots about the terrain ahead of them, within {AHEAD_M:g} m and "
        f"{AHEAD_DEG:g}° to either side, where they have not measured λ: RMSE of E[λ] "
        "and mean log score, over the time since the start. Lines are means over the "
        f"maps on which a robot still drives, one for every {_BIN_S:g} s; bands are "
        "95 % intervals (bootstrap over maps). Times with fewer than "
        f"{LEAST_MAPS} maps are left out."
    )

    curves = pd.DataFrame()

    def variants(self, data: RunData) -> Sequence[Self]:
        """Return one figure if robots learnt on enough maps and steps were stored."""
        curves = (
            read_learning(data.folder, data.episodes) if data.folder else self.curves
        )
        return [self.variant(curves=curves)] if len(curves) else []

    def draw(self, data: RunData) -> Drawing:
        """Draw a line with a band for each condition, in several panels if many."""
        rows = data.summary[
            data.summary["condition"].isin(self.curves["condition"])
        ].reset_index(drop=True)
        differing = [
            name
            for name in dict.fromkeys((*BLOCK, *NAMING))
            if name in rows and rows[name].nunique() > 1
        ]
        titled, groups = divide_lines(
            rows, [(*BLOCK, *extra) for extra in _PANEL_COLUMNS]
        )
        named = [name for name in differing if name not in titled]
        labels = (
            [reading_name(name, row[name]) for name in named]
            for row in rows.to_dict("records")
        )
        names = [joined(row_labels) or "mean over maps" for row_labels in labels]
        letters = int(
            (TWO_COLUMNS_IN / min(len(groups), MAX_ACROSS) - 0.4) / _LETTER_IN
        )
        points = []
        for title, shown in groups:
            panel = textwrap.fill(title, letters)
            for index in shown:
                is_line = self.curves["condition"] == rows["condition"][index]
                points.append(
                    self.curves[is_line].assign(panel=panel, line=names[index])
                )
        table = pd.concat(points).rename(columns={"time_s": "x"})
        looks = line_looks(names, dashed=True)
        figure, panels = Curves(
            table=table, measures=METRICS, looks=looks, x_label="seconds of experience"
        ).draw()
        next(iter(panels.values())).set_xlim(left=0)
        legend_outside(figure)
        return figure


def read_learning(folder: Path, episodes: pd.DataFrame) -> pd.DataFrame:
    """Read the accuracy of the belief ahead of robots, over the time since the start.

    Args:
        folder: a finished run.
        episodes: rows of the run.

    Returns:
        A row a condition and time bin with at least `LEAST_MAPS` maps, or groups of
        maps: `condition`; `time_s`, the middle of the bin; `maps`, their number; and
        the mean of each of `METRICS` over them, with its 95 % interval in the columns
        `_low` and `_high`. Empty if no robot learnt, or no steps were stored.
    """
    names = list(METRICS)
    columns = [
        "condition",
        "time_s",
        "maps",
        *(f"{name}{end}" for name in names for end in ("", "_low", "_high")),
    ]
    tables = [
        rows.loc[rows[names[0]].notna(), [*_EPISODE, "time_s", *names]]
        for rows in step_files(folder)
        if names[0] in rows
    ]
    if not tables:
        return pd.DataFrame(columns=columns)
    steps = pd.concat(tables).merge(episodes[[*_EPISODE, "group"]], on=_EPISODE)
    steps["bin"] = (steps["time_s"] / _BIN_S + 1e-6).astype(int)
    # Each episode counts once in a bin, and each map once, however many episodes.
    once = steps.groupby([*_EPISODE, "group", "bin"])[names].mean()
    by_map = once.groupby(["condition", "bin", "group"])[names].mean()
    rows = []
    for (condition, bin_index), group in by_map.groupby(["condition", "bin"]):
        if len(group) < LEAST_MAPS:
            continue
        values = group.to_numpy(np.float64)
        low, high = np.quantile(
            bootstrap_counts(len(group)) @ values / len(group), [0.025, 0.975], axis=0
        )
        numbers = np.stack((values.mean(axis=0), low, high), axis=1).ravel()
        rows.append((condition, (bin_index + 0.5) * _BIN_S, len(group), *numbers))
    return pd.DataFrame(rows, columns=columns)
