"""A sheet of failures: small maps of what was predicted, the path driven on them, and where it ended.

Letters in shapes: N episodes, H×W cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchnav.eval.report.figure_style import TRAVERSABILITY_COLOURS, TWO_COLUMNS_IN
from benchnav.eval.report.recorded.ground import IMMOBILISING

ACROSS = 4


@dataclass(frozen=True, kw_only=True)
class FailedGround:
    """The ground of failed episodes of one condition.

    Args:
        predicted: λ̂, the map the planner was given, shape [N, H, W].
        immobilising: cells that immobilise a robot, bool, shape [N, H, W]; false where λ was resampled.
        resolution_m: edge length of a cell.
        goal_m: (x, y), shape [N, 2].
    """

    predicted: np.ndarray
    immobilising: np.ndarray
    resolution_m: float
    goal_m: np.ndarray

    def told(self, places_m: np.ndarray) -> np.ndarray:
        """λ̂ at a place of each episode, (x, y) of shape [N, 2]; NaN outside the map or where there is no place."""
        cells = np.floor(np.nan_to_num(places_m, nan=-1.0) / self.resolution_m).astype(int)
        column, row = cells.T
        height, width = self.predicted.shape[1:]
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        values = self.predicted[np.arange(len(row)), row.clip(0, height - 1), column.clip(0, width - 1)]
        return np.where(inside, values, np.nan)


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A line of the sheet: failures of one condition.

    Args:
        name: of the condition.
        failures: rows of `failures.failures_table`, at most `ACROSS`.
        ground: of these.
        tracks: driven positions of each, shape [steps, 2].
        among: number of failures that these were chosen of.
    """

    name: str
    failures: pd.DataFrame
    ground: FailedGround
    tracks: Sequence[np.ndarray]
    among: int


def choose(failures: pd.DataFrame) -> pd.DataFrame:
    """Chooses failures to be shown: each outcome once before any twice, the most frequent outcome first."""
    placed = failures[failures["x_m"].notna()]
    turn = placed.groupby("outcome", sort=False).cumcount()
    often = -placed.groupby("outcome")["outcome"].transform("size")
    return placed.assign(turn=turn, often=often).sort_values(["turn", "often"], kind="stable").head(ACROSS)


def failure_sheet(lines: Sequence[Shown]) -> Figure:
    """Draws the sheet, a line a condition.

    Args:
        lines: one or more.
    """
    height, width = lines[0].ground.predicted.shape[1:]
    tall = TWO_COLUMNS_IN / (ACROSS + 0.9) * min(height / width, 2.0) + 0.4
    figure = Figure(figsize=(TWO_COLUMNS_IN, tall * len(lines) + 0.45), layout="constrained")
    panels = figure.subplots(len(lines), ACROSS, squeeze=False)
    for panel in panels.flat:
        panel.set_visible(False)
    for across, line in zip(panels, lines, strict=True):
        for place, row in enumerate(line.failures.to_dict("records")):
            _draw(across[place], line, place)
            told = line.ground.told(line.failures[["x_m", "y_m"]].to_numpy())[place]
            across[place].set_title(
                f"{row['scenario']} {row['map']}: {row['outcome'].replace('_', ' ')}, "
                f"{row['end_time_s']:.0f} s\n{_words(told, row['last_traversability'])}",
                fontsize=6.5,
            )
        across[0].set_ylabel(f"{line.name}\n({len(line.failures)} of {line.among} failures)", fontsize=6.5)
    colours = panels.flat[0].images[0]
    figure.colorbar(colours, ax=panels, fraction=0.02, aspect=30, label="predicted λ̂")
    figure.legend(handles=_legend(lines), loc="outside lower center", ncols=5)
    return figure


def _words(told: float, met: float) -> str:
    known = "outside the map" if np.isnan(told) else f"λ̂ = {told:.2f}"
    return f"{known}, observed λ = {met:.2f}" if not np.isnan(met) else known


def _draw(panel: Axes, line: Shown, place: int) -> None:
    ground = line.ground
    height, width = (count * ground.resolution_m for count in ground.predicted.shape[1:])
    extent = (0, width, 0, height)
    panel.set_visible(True)
    panel.imshow(
        ground.predicted[place], origin="lower", extent=extent, cmap=TRAVERSABILITY_COLOURS, vmin=0, vmax=1
    )
    if ground.immobilising[place].any():
        held = np.zeros((*ground.immobilising.shape[1:], 4))
        held[ground.immobilising[place]] = [*(value / 255 for value in IMMOBILISING), 0.75]
        panel.imshow(held, origin="lower", extent=extent)
    track = line.tracks[place]
    for colour, thick in (("white", 2.4), ("black", 1.1)):
        panel.plot(*track.T, color=colour, lw=thick, solid_capstyle="round")
    panel.plot(*track[0], "o", color="white", mec="black", ms=4, mew=0.8)
    panel.plot(*ground.goal_m[place], "*", color="white", mec="black", ms=8, mew=0.8)
    panel.plot(*track[-1], "X", color="white", mec="black", ms=7, mew=0.9)
    panel.spines[:].set_visible(False)
    panel.set(xlim=(0, width), ylim=(0, height), xticks=[], yticks=[], aspect="equal")


def _legend(lines: Sequence[Shown]) -> list[Line2D | Patch]:
    marks: list[Line2D | Patch] = [
        Line2D([], [], ls="none", marker=marker, color="white", mec="black", ms=size, label=label)
        for marker, size, label in (("o", 4, "start"), ("*", 8, "goal"), ("X", 6, "end"))
    ]
    marks.append(Line2D([], [], color="black", lw=1.1, label="driven"))
    if any(line.ground.immobilising.any() for line in lines):
        red, green, blue = (value / 255 for value in IMMOBILISING)
        marks.append(Patch(color=(red, green, blue), label="ground that immobilises a robot"))
    return marks
