"""How well λ is known ahead of robots that learn, over the time since they set out."""

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

# Of each column what its panels are called, and which way is better.
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
_WAYS = ((), ("model",), ("planner", "model"), ("planner", "risk", "model"))
_LETTER_IN = 0.055
_EPISODE = ["condition", "seed", "realisation", "map"]


class Learning(Figure):
    """RMSE and log score of what is believed ahead of robots, over the seconds of
    experience.
    """

    name = "learning"
    text = (
        f"What robots know of the terrain ahead of them, within {AHEAD_M:g} m and "
        f"{AHEAD_DEG:g}° to either side, "
        "where they have not sensed λ: RMSE of E[λ] and mean log score of the belief, "
        "over the time since they set "
        "out. Means over the maps on which a robot still drives, one for every "
        f"{_BIN_S:g} s, with 95 % intervals "
        f"(bootstrap over maps). Times with fewer than {LEAST_MAPS} maps are left out."
    )

    curves = pd.DataFrame()

    def variants(self, data: RunData) -> Sequence[Self]:
        """Return one figure where robots learnt, steps were kept, and there are enough
        maps.
        """
        curves = (
            read_learning(data.folder, data.episodes) if data.folder else self.curves
        )
        return [self.variant(curves=curves)] if len(curves) else []

    def draw(self, data: RunData) -> Drawing:
        """Draw a line a condition, with its band; where these are many, a panel a
        model, planner and risk setting.
        """
        rows = data.summary[
            data.summary["condition"].isin(self.curves["condition"])
        ].reset_index(drop=True)
        differing = [
            name
            for name in dict.fromkeys((*BLOCK, *NAMING))
            if name in rows and rows[name].nunique() > 1
        ]
        titled, groups = divide_lines(rows, [(*BLOCK, *more) for more in _WAYS])
        named = [name for name in differing if name not in titled]
        labels = (
            [reading_name(name, row[name]) for name in named]
            for row in rows.to_dict("records")
        )
        names = [joined(own) or "mean over maps" for own in labels]
        letters = int(
            (TWO_COLUMNS_IN / min(len(groups), MAX_ACROSS) - 0.4) / _LETTER_IN
        )
        points = [
            self.curves[self.curves["condition"] == rows["condition"][index]].assign(
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


def read_learning(folder: Path, episodes: pd.DataFrame) -> pd.DataFrame:
    """Read how well λ was known ahead of the robots of a run, over the time since they
    set out.

    Args:
        folder: a finished run.
        episodes: its rows.

    Returns:
        A row a condition and bin of time that at least `LEAST_MAPS` maps, or groups of
        maps, tell of: `condition`, `time_s`, the middle of the bin, `maps`, how many
        these are, and of each of `METRICS` its mean over them, with its 95 % interval
        in the columns that end in `_low` and `_high`. No row where no robot learnt, or
        no steps were kept.
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
        low, high = np.quantile(
            bootstrap_counts(len(own)) @ values / len(own), [0.025, 0.975], axis=0
        )
        numbers = np.stack((values.mean(axis=0), low, high), axis=1).ravel()
        rows.append((condition, (place + 0.5) * _BIN_S, len(own), *numbers))
    return pd.DataFrame(rows, columns=columns)
