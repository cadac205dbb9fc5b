"""Accuracy of the belief about the terrain ahead of robots that learn, over time."""

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
from benchnav.eval.words import NAMING, display_name, joined
from benchnav.stats.bootstrap import LEAST_MAPS, bootstrap_counts
from benchnav.viz.figure import Figure
from benchnav.viz.panels import Curves, line_looks
from benchnav.viz.style import TWO_COLUMNS_IN, legend_outside

_TITLES = (
    "RMSE of E[λ] ahead\n(lower is better)",
    "log score ahead\n(higher is better)",
)
# Titles of panels by column of steps, with the better direction.
METRICS = dict(zip(AHEAD_COLUMNS, _TITLES, strict=True))
_BIN_S = 2.0  # length of a time bin
_PANEL_COLUMNS = ((), ("model",), ("planner", "model"), ("planner", "risk", "model"))
_LETTER_IN = 0.055  # mean width of a letter of a title
_EPISODE = ["condition", "seed", "realisation", "map"]


class Learning(Figure):
    """RMSE and log score of the belief ahead of robots, over time since the start."""

    name = "learning"
    text = (
        "Accuracy of the belief about the terrain ahead of a robot: cells within "
        f"{AHEAD_M:g} m and {AHEAD_DEG:g}° to either side whose λ was not measured. "
        "RMSE of E[λ] and mean log score, over the time since the start. Lines are "
        f"means in bins of {_BIN_S:g} s, over the maps on which a robot still drives. "
        "Bands are 95 % intervals (bootstrap over maps). Bins with fewer than "
        f"{LEAST_MAPS} maps are left out."
    )

    curves = pd.DataFrame()

    def variants(self, data: RunData) -> Sequence[Self]:
        """Return one figure if robots learnt on enough maps and the run has steps."""
        curves = self.curves
        if data.folder:
            curves = read_learning(data.folder, data.episodes)
        return [self.variant(curves=curves)] if len(curves) else []

    def draw(self, data: RunData) -> Drawing:
        """Draw a line with a band for each condition; many lines fill several panels."""
        has_curve = data.summary["condition"].isin(self.curves["condition"])
        rows = data.summary[has_curve].reset_index(drop=True)
        panel_columns = [(*BLOCK, *extra) for extra in _PANEL_COLUMNS]
        titled, groups = divide_lines(rows, panel_columns)
        names = _line_names(rows, titled)
        across = min(len(groups), MAX_ACROSS)
        panel_in = TWO_COLUMNS_IN / across - 0.4
        letters = int(panel_in / _LETTER_IN)
        points = []
        for title, shown in groups:
            panel = textwrap.fill(title, letters)
            for index in shown:
                is_on_curve = self.curves["condition"] == rows["condition"][index]
                curve = self.curves[is_on_curve]
                points.append(curve.assign(panel=panel, line=names[index]))
        curves = Curves(
            table=pd.concat(points).rename(columns={"time_s": "x"}),
            measures=METRICS,
            looks=line_looks(names, dashed=True),
            x_label="time since the start [s]",
        )
        figure, panels = curves.draw()
        first_panel = next(iter(panels.values()))
        first_panel.set_xlim(left=0)
        legend_outside(figure)
        return figure


def _line_names(rows: pd.DataFrame, titled: Sequence[str]) -> list[str]:
    """Name lines by the labels that differ and that no panel's title contains."""
    columns = [name for name in dict.fromkeys((*BLOCK, *NAMING)) if name in rows]
    differing = [name for name in columns if rows[name].nunique() > 1]
    named = [name for name in differing if name not in titled]
    names = []
    for row in rows.to_dict("records"):
        name = joined(display_name(column, row[column]) for column in named)
        names.append(name or "mean over maps")
    return names


def read_learning(folder: Path, episodes: pd.DataFrame) -> pd.DataFrame:
    """Read the accuracy of the belief ahead of robots, over the time since the start.

    Args:
        folder: a finished run.
        episodes: rows of the run.

    Returns:
        One row per condition and time bin with at least `LEAST_MAPS` maps, or groups of
        maps: `condition`; `time_s`, the middle of the bin; `maps`, the number of maps
        or groups; and for each of `METRICS` the mean over maps, with its 95 % interval
        in columns that end in `_low` and `_high`. Empty if no robot learnt or the run
        has no steps.
    """
    names = list(METRICS)
    first_name = names[0]
    metric_columns = [f"{name}{end}" for name in names for end in ("", "_low", "_high")]
    columns = ["condition", "time_s", "maps", *metric_columns]
    tables = []
    for rows in step_files(folder):
        if first_name in rows:
            is_known = rows[first_name].notna()
            tables.append(rows.loc[is_known, [*_EPISODE, "time_s", *names]])
    if not tables:
        return pd.DataFrame(columns=columns)
    steps = pd.concat(tables).merge(episodes[[*_EPISODE, "group"]], on=_EPISODE)
    steps["bin"] = (steps["time_s"] / _BIN_S + 1e-6).astype(int)
    # In a bin, all episodes of a map have the same weight, and so have all maps.
    by_episode = steps.groupby([*_EPISODE, "group", "bin"])[names].mean()
    by_map = by_episode.groupby(["condition", "bin", "group"])[names].mean()
    points = []
    for (condition, bin_index), group in by_map.groupby(["condition", "bin"]):
        n_maps = len(group)
        if n_maps < LEAST_MAPS:
            continue
        values = group.to_numpy(np.float64)
        bootstrap_means = bootstrap_counts(n_maps) @ values / n_maps
        low, high = np.quantile(bootstrap_means, [0.025, 0.975], axis=0)
        means = values.mean(axis=0)
        numbers = np.stack((means, low, high), axis=1).ravel()
        time_s = (bin_index + 0.5) * _BIN_S
        points.append((condition, time_s, n_maps, *numbers))
    return pd.DataFrame(points, columns=columns)
