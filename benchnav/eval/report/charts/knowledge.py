"""Figures of robots that learn on their way: what one knew when, and how well λ is known ahead of all of them."""

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.compute as pc
import pyarrow.dataset as ds
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, withStroke

from benchnav.core.figures import (
    LINE_COLOURS,
    TRAVERSABILITY_COLOURS,
    TWO_COLUMNS_IN,
    draw_edged,
    frame_map,
    legend_outside,
    line_style,
    mark,
    robot_marker,
    show_map,
    stack_panels,
    styled,
)
from benchnav.core.grid import outline
from benchnav.eval.folder.steps import AHEAD_COLUMNS, AHEAD_DEG, AHEAD_M, open_steps, rows_of
from benchnav.eval.recording import KnownMap, Recording
from benchnav.eval.report.charts.maps import choose_recordings
from benchnav.eval.report.plan_layers import (
    MOST_SPREAD,
    SPREAD_COLOURS,
    UNSEEN,
    VEIL,
    end_cell_handle,
    mark_end,
    reach_line,
    unseen_handle,
    unseen_layer,
)
from benchnav.eval.report.words import NAMING, contender_names, joined, reading_name
from benchnav.eval.stats.best import BLOCK
from benchnav.stats.bootstrap import LEAST_MAPS, bootstrap_counts

# Of each column what its panels are called, and which way is better.
_CALLED = ("RMSE of E[λ] ahead (lower is better)", "log score ahead (higher is better)")
METRICS = dict(zip(AHEAD_COLUMNS, _CALLED, strict=True))

# Of each line of the figure of what was known its label, its colours, and what has the lightest.
_SHOWN = {
    "mean": ("E[λ]", TRAVERSABILITY_COLOURS, 1.0),
    "spread": ("spread of λ", SPREAD_COLOURS, MOST_SPREAD),
}
_MOMENTS = 4
_SENSED = "white"
_THIN = 0.6  # of the width that lines have where a map is alone

_BIN_S = 2.0
_MOST_LINES, _MOST_ACROSS = 7, 4
_LETTER_IN = 0.055
_EPISODE = ["condition", "seed", "realisation", "map"]


def draw_knowledge(
    folder: Path, episodes: pd.DataFrame, summary: pd.DataFrame, recorded: Sequence[Recording]
) -> Iterator[tuple[str, str, Figure]]:
    """Draws all there is of what the robots of a run knew; nothing where none learnt on its way.

    Args:
        folder: a finished run.
        episodes: its rows.
        summary: of the run.
        recorded: all recordings that there are.

    Returns:
        Names, captions and figures.
    """
    curves = read_learning(folder, episodes)
    if len(curves):
        yield (
            "learning",
            f"What robots know of the ground ahead of them, within {AHEAD_M:g} m and {AHEAD_DEG:g}° to either side, "
            "where they have not sensed λ: RMSE of E[λ] and mean log score of the belief, over the time since they set "
            f"out. Means over the maps on which a robot still drives, one for every {_BIN_S:g} s, with 95 % intervals "
            f"(bootstrap over maps). Times that fewer than {LEAST_MAPS} maps tell of are left out.",
            learning_figure(curves, summary),
        )
    chosen = choose_recordings([own for own in recorded if own.known], list(summary["condition"]))
    names = contender_names([own.about for own in chosen])
    for place, (own, name) in enumerate(zip(chosen, names, strict=True), start=1):
        yield (
            "knowledge" if len(chosen) == 1 else f"knowledge-{place}",
            f"What a robot knew of {own.about['scenario']}, map {own.about['map']}, on its way ({name}): E[λ] of its "
            "belief above, and below its spread, half of the range from the 16 % to the 84 % quantile of λ.",
            knowledge_figure(own),
        )


@styled()
def knowledge_figure(recording: Recording) -> Figure:
    """Draws what a robot knew at four moments, from its start to its end: E[λ] above, its spread below.

    Args:
        recording: with what was known.
    """
    last = len(recording.traversability)
    steps = sorted({round(step) for step in np.linspace(0, last, _MOMENTS)})
    moments = [(step, recording.known_at(step) or recording.known[0]) for step in steps]
    ratio = min(max(recording.grid.height / recording.grid.width, 0.3), 2.0)
    tall = (TWO_COLUMNS_IN - 0.9) / _MOMENTS * ratio
    figure = Figure(figsize=(TWO_COLUMNS_IN, 2 * tall + 1.1), layout="compressed")
    panels = figure.subplots(2, len(moments), squeeze=False, sharex=True, sharey=True)
    for row, (name, (label, colours, most)) in zip(panels, _SHOWN.items(), strict=True):
        for panel, (step, known) in zip(row, moments, strict=True):
            values: np.ndarray = getattr(known, name)
            image = show_map(panel, values, recording.grid.extent_m, cmap=colours, vmin=0, vmax=most)
            _draw_known(panel, known, recording.resolution_m)
            _draw_robot(panel, recording, step)
        row[0].set_ylabel("y [m]")
        figure.colorbar(image, ax=list(row), fraction=0.03, aspect=20, label=label)
    for (above, below), (step, _) in zip(panels.T, moments, strict=True):
        ended = f"\n{recording.outcome}" if step == last else ""
        above.set_title(f"t = {step * recording.dt_s:.1f} s{ended}", fontsize="small")
        below.set_xlabel("x [m]")
    every = [known for _, known in moments]
    handles: list[Artist] = [end_cell_handle()]
    if any(known.sensed.any() for known in every):
        edge = [withStroke(linewidth=2, foreground="black"), Normal()]
        handles.append(
            Line2D([], [], color=_SENSED, lw=0.8, path_effects=edge, label="edge of where λ was sensed")
        )
    if any(not known.seen.all() for known in every):
        handles.append(unseen_handle())
    if any(known.outlines for known in every):
        handles.append(reach_line(np.empty((0, 2)), _THIN, "reach of the sensors"))
    legend_outside(figure, handles, 5)
    return figure


def _draw_known(panel: Axes, known: KnownMap, resolution_m: float) -> None:
    """Veils and hatches what was not seen, outlines what was sensed, and draws how far the sensors reached."""
    height, width = known.seen.shape
    veil = np.zeros((height, width, 4))
    veil[~known.seen] = to_rgba(UNSEEN, VEIL)
    show_map(panel, veil, (width * resolution_m, height * resolution_m))
    panel.add_collection(unseen_layer(known.seen, resolution_m))
    sensed = list(outline(known.sensed, resolution_m))
    panel.add_collection(LineCollection(sensed, colors=_SENSED, linewidths=0.5))
    panel.add_line(reach_line(known.outline, _THIN))


def _draw_robot(panel: Axes, recording: Recording, step: int) -> None:
    """Draws the path driven by a step, start and goal, and the robot, or how its episode ended."""
    track = recording.track[: step + 1]
    draw_edged(panel, track, 1.2, label="driven")
    mark(panel, "start", track[0], 0.8)
    mark(panel, "goal", recording.goal_m, 0.8)
    if step < len(recording.traversability):
        mark(panel, "robot", track[-1], 0.8, marker=robot_marker(recording.states[step, 2]))
    else:
        mark_end(panel, recording.about["outcome"], track, recording.goal_m, recording.resolution_m, 0.8)
    frame_map(panel)


def read_learning(folder: Path, episodes: pd.DataFrame) -> pd.DataFrame:
    """Reads how well λ was known ahead of the robots of a run, over the time since they set out.

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
    source = open_steps(folder)
    if source is None or not set(names) <= set(source.schema.names):
        return pd.DataFrame(columns=columns)
    told = pc.is_finite(ds.field(names[0]))
    steps = rows_of(folder, source, [*_EPISODE, "time_s", *names], told)
    steps = steps.merge(episodes[[*_EPISODE, "group"]], on=_EPISODE)
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


@styled()
def learning_figure(curves: pd.DataFrame, summary: pd.DataFrame) -> Figure:
    """Draws how well λ is known ahead of robots over the time since they set out: RMSE above, log score below.

    A line a condition, with the 95 % band; where these are many, a panel for each model, planner and risk setting.

    Args:
        curves: from `read_learning`, at least one row.
        summary: of the run, which holds the labels of conditions.
    """
    rows = summary[summary["condition"].isin(curves["condition"])].reset_index(drop=True)
    groups, names = _share_out(rows)
    across = min(len(groups), _MOST_ACROSS)
    down = -(-len(groups) // across)
    figure = Figure(figsize=(TWO_COLUMNS_IN, 2.4 if across == 1 else 3.3 * down + 0.5), layout="constrained")
    if across == 1:  # side by side, since there is room
        stacks = [list(figure.subplots(1, 2, sharex=True))]
    else:
        stacks = stack_panels(figure, len(groups), across, layers=2, sharex=True)
    letters = int((TWO_COLUMNS_IN / across - 0.4) / _LETTER_IN)
    looks = {name: place for place, name in enumerate(dict.fromkeys(names))}
    for place, (stack, (title, shown)) in enumerate(zip(stacks, groups, strict=True)):
        for panel, (metric, label) in zip(stack, METRICS.items(), strict=True):
            for index in shown:
                own = curves[curves["condition"] == rows["condition"][index]]
                look = looks[names[index]]
                colour = LINE_COLOURS[look % len(LINE_COLOURS)]
                panel.fill_between(
                    own["time_s"], own[f"{metric}_low"], own[f"{metric}_high"], color=colour, alpha=0.15, lw=0
                )
                panel.plot(
                    own["time_s"], own[metric], color=colour, ls=line_style(look), lw=1.2, label=names[index]
                )
            panel.grid(axis="y", color="0.9")
            panel.tick_params(labelleft=place % across == 0)
            panel.set_ylabel(label.replace(" (", "\n(") if place % across == 0 else "")
            if panel is stack[-1] or across == 1:
                panel.set_xlabel("seconds of experience")
                panel.tick_params(labelbottom=True)
        stack[0].set_title(textwrap.fill(title, letters), fontsize="small")
        if place:
            for panel, first in zip(stack, stacks[0], strict=True):
                panel.sharey(first)
    stacks[0][0].set_xlim(left=0)
    legend_outside(figure)
    return figure


def _share_out(rows: pd.DataFrame) -> tuple[list[tuple[str, list[int]]], list[str]]:
    """Titles and conditions of panels, and what each condition is called in all of them.

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
        if max(len(own) for _, own in groups) <= _MOST_LINES:
            break
    named = [name for name in differing if name not in titled]

    def words(columns: Sequence[str], row: Any) -> str:
        return joined(reading_name(name, row[name]) for name in columns)

    names = [words(named, row) or "mean over maps" for row in rows.to_dict("records")]
    return [(words(titled, own.iloc[0]), own.index.tolist()) for _, own in groups], names
