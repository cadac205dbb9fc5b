"""Figures on the maps of a run: trajectories (after the paper's Fig. 2), whole driven paths, and failures."""

import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from benchnav.core.figures import (
    ONE_COLUMN_IN,
    TRAVERSABILITY_COLOURS,
    TWO_COLUMNS_IN,
    condition_colours,
    draw_edged,
    legend_outside,
    mark,
    mark_handle,
    show_map,
    styled,
    thin_ticks,
    unit,
)
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.report.charts.driven import DrivenGround
from benchnav.eval.report.failure_choice import FailedLine
from benchnav.eval.report.recorded.drawn_plan import STYLES, LayerStyle
from benchnav.eval.report.recorded.ground import (
    IMMOBILISING,
    SOFT,
    field_colours,
    hatching,
    immobilised_at,
    outline,
)
from benchnav.eval.report.recorded.snapshot import Snapshot
from benchnav.eval.report.words import NAMING, condition_name, contender_names, differ, outcome_in_words

MOST_PANELS = 8
_PANELS_A_LINE = 4
_LINE_WIDTH = 0.4  # of the thinnest line of a plan
_CLOSED = "0.25"
_LETTER_IN = 0.048
_SAME_MAP = ("data", "scenario", "map", "seed", "realisation")
_PATH_STYLES = ("solid", "dashed")
_DARKEST = 0.35  # grey of λ = 0
_LAMBDA: dict[str, Any] = {"cmap": TRAVERSABILITY_COLOURS, "vmin": 0, "vmax": 1}


def choose_snapshots(snapshots: Sequence[Snapshot], conditions: Sequence[str]) -> list[Snapshot]:
    """Chooses one snapshot a condition, all of one map where there are such, at most `MOST_PANELS`.

    Of the maps that the first condition was recorded on it is the first on which outcomes differ, if there is one;
    else the first on which an episode failed.

    Args:
        snapshots: all there are.
        conditions: ids in the order wanted.
    """
    order = {condition: place for place, condition in enumerate(conditions)}
    known = [snapshot for snapshot in snapshots if snapshot.about["condition"] in order]
    known.sort(key=lambda s: (order[s.about["condition"]], int(s.about["map"])))
    outcomes: dict[tuple[str, ...], set[str]] = {}
    for snapshot in known:
        outcomes.setdefault(_map(snapshot), set()).add(snapshot.about["outcome"])
    maps = [
        _map(snapshot) for snapshot in known if snapshot.about["condition"] == known[0].about["condition"]
    ]
    differing = [place for place in maps if len(outcomes[place]) > 1]
    failed = [place for place in maps if outcomes[place] != {"success"}]
    shown = next(iter([*differing, *failed, *maps]), ())
    known.sort(key=lambda s: _map(s) != shown)
    first: dict[str, Snapshot] = {}
    for snapshot in known:
        first.setdefault(snapshot.about["condition"], snapshot)
    return sorted(first.values(), key=lambda s: order[s.about["condition"]])[:MOST_PANELS]


def _map(snapshot: Snapshot) -> tuple[str, ...]:
    return tuple(snapshot.about[name] for name in _SAME_MAP)


@styled()
def trajectory_figure(snapshots: Sequence[Snapshot]) -> Figure:
    """Draws snapshots side by side: the terrain above with what was planned, the map planned on below.

    Where λ stayed what it was through an episode, a third row shows it, with the whole driven path.

    Args:
        snapshots: at least one.
    """
    lines = -(-len(snapshots) // _PANELS_A_LINE)
    across = -(-len(snapshots) // lines)  # as full as lines can be
    layers = 2 if all(snapshot.field is None for snapshot in snapshots) else 3
    width = ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN
    panel_in = (width - 0.9) / across - 0.1
    tallest = max(float(snapshot.extent_m[1] / snapshot.extent_m[0]) for snapshot in snapshots)
    tall = panel_in * min(max(tallest, 0.3), 2.0) + 0.35
    figure = Figure(figsize=(width, (layers * tall + 0.2) * lines + 0.8), layout="compressed")
    panels = figure.subplots(layers * lines, across, squeeze=False)
    for panel in panels.flat:
        panel.set_visible(False)
    several = [name for name in ("model", "world") if differ(snapshot.about[name] for snapshot in snapshots)]
    letters = int(panel_in / _LETTER_IN)
    for place, snapshot in enumerate(snapshots):
        first = layers * (place // across)
        above, below, *last = panels[first : first + layers, place % across]
        about = snapshot.about
        heading = f"{condition_name(about, several)}, {about['scenario']} {about['map']}"
        moment = f"t = {snapshot.time_s:g} s; outcome: {outcome_in_words(about['outcome'])}"
        driven = _draw_terrain(above, snapshot)
        _name_panel(above, letters, heading, moment)
        _draw_predicted(below, snapshot, letters)
        for panel in (above, below):
            for name, style in STYLES.items():
                if len(snapshot.plan.lines.get(name, ())):
                    panel.add_collection(plan_layer(style, snapshot.plan.lines[name]))
            _mark_places(panel, snapshot, snapshot.track[snapshot.now])
        if snapshot.field is not None:
            _draw_field(last[0], snapshot, snapshot.field, letters)
        (below if snapshot.field is None else last[0]).set_xlabel("x [m]")
        for panel in panels[first : first + layers, place % across]:
            panel.tick_params(labelleft=place % across == 0)
    for panel in panels[:, 0]:
        panel.set_ylabel("y [m]")
    legend_outside(figure, _ground_entries(snapshots), 1 if across == 1 else 4)
    shrink = min(1.0, 4 / figure.get_figheight())
    figure.colorbar(
        driven, ax=panels, fraction=0.03, aspect=40, shrink=shrink, anchor=(0, 1), label="traversability λ"
    )
    return figure


def _name_panel(panel: Axes, letters: int, *lines: str) -> None:
    """Sets the title of a panel, broken where it is wider than so many letters."""
    panel.set_title("\n".join(textwrap.fill(line, letters) for line in lines), fontsize="small")


def _draw_terrain(panel: Axes, snapshot: Snapshot) -> LineCollection:
    """Draws the terrain, and the path driven by that moment, coloured by the observed λ."""
    show_map(panel, np.moveaxis(snapshot.rgb, 0, -1), snapshot.extent_m)
    if snapshot.field is not None:
        for lines in soft_lines(snapshot.soft, float(snapshot.extent_m[0]) / snapshot.soft.shape[1]):
            panel.add_collection(lines)
    driven = snapshot.track[: snapshot.now + 1]
    segments = np.stack((driven[:-1], driven[1:]), axis=1)
    coloured = LineCollection(list(segments), cmap=TRAVERSABILITY_COLOURS, linewidths=2, capstyle="round")
    coloured.set_array(snapshot.traversability[: snapshot.now])
    coloured.set_clim(0, 1)
    coloured.set_zorder(2.5)
    panel.plot(*driven.T, color="white", lw=3.2, solid_capstyle="round")
    panel.add_collection(coloured)
    return coloured


def _draw_predicted(panel: Axes, snapshot: Snapshot, letters: int) -> None:
    """Draws the λ̂ that the planner was given, and the path in black, since the map has the colours of λ."""
    show_map(panel, snapshot.predicted, snapshot.extent_m, **_LAMBDA)
    if not snapshot.free.all():
        closed = np.where(snapshot.free, np.nan, 1.0)
        show_map(panel, closed, snapshot.extent_m, cmap=ListedColormap([_CLOSED]))
    blind = snapshot.about["model"] == NOT_USED
    words = "E[λ] in truth; the planner is given nothing" if blind else "λ̂ given to the planner"
    _name_panel(panel, letters, words)
    words = "driven; above in the colour of the observed λ"
    draw_edged(panel, snapshot.track[: snapshot.now + 1], 1.4, label=words)


def _draw_field(panel: Axes, snapshot: Snapshot, field: np.ndarray, letters: int) -> None:
    """Draws λ as it was, and the whole driven path over it."""
    show_map(panel, field_colours(field, snapshot.immobilising), snapshot.extent_m)
    draw_edged(panel, snapshot.track, 1.4)
    _mark_places(panel, snapshot, snapshot.track[-1])
    if immobilised_at(snapshot.about, snapshot.track) is not None:
        mark(panel, "end", snapshot.track[-1], label="immobilised")
    end_s = len(snapshot.traversability) * snapshot.dt_s
    _name_panel(panel, letters, f"driven to the end ({end_s:g} s), on λ as it was")


def _mark_places(panel: Axes, snapshot: Snapshot, robot: np.ndarray) -> None:
    """Marks start, goal and robot, and gives the panel its axes."""
    panel.set_visible(True)
    for name, place in (("start", snapshot.track[0]), ("goal", snapshot.goal_m), ("robot", robot)):
        mark(panel, name, place, label=name)
    panel.set(xlim=(0, snapshot.extent_m[0]), ylim=(0, snapshot.extent_m[1]), aspect="equal")
    thin_ticks(panel)


def plan_layer(style: LayerStyle, lines: Sequence[np.ndarray] = ()) -> LineCollection:
    """A layer of a plan as lines that can be put on a map."""
    return LineCollection(
        list(lines),
        colors=[unit(style.colour)],
        linewidths=_LINE_WIDTH * style.width,
        linestyles="dashed" if style.dashed else "solid",
        label=style.label,
    )


def soft_lines(soft: np.ndarray, resolution_m: float) -> Iterator[LineCollection]:
    """Outline and hatching of soft ground, bool of shape [H, W]."""
    for lines in (outline, hatching):
        yield LineCollection(list(lines(soft, resolution_m)), colors=[unit(SOFT)], linewidths=0.4)


def _ground_entries(snapshots: Sequence[Snapshot]) -> list[Artist]:
    """Entries of the legend for what is drawn of the ground."""
    known = [snapshot for snapshot in snapshots if snapshot.field is not None]
    entries: list[Artist] = []
    if not all(snapshot.free.all() for snapshot in snapshots):
        entries.append(Patch(color=_CLOSED, label="not free"))
    if any(snapshot.soft.any() for snapshot in known):
        entries.append(
            Patch(fc="0.45", ec=unit(SOFT), hatch="////", label="soft ground, which does not show")
        )
    if any(snapshot.immobilising.any() for snapshot in known):
        entries.append(Patch(color=unit(IMMOBILISING), label="immobilises a robot"))
    return entries


@styled()
def driven_figure(ground: DrivenGround, rows: pd.DataFrame, tracks: Sequence[np.ndarray]) -> Figure:
    """Draws whole driven paths over λ as it was, or over faded terrain where it was resampled.

    Args:
        ground: the map.
        rows: an episode a condition, one or more.
        tracks: positions of each, shape [N + 1, 2].
    """
    high, wide = (count * ground.resolution_m for count in ground.immobilising.shape)
    figure = Figure(
        figsize=(TWO_COLUMNS_IN, max(3.4, min(3.8 * high / wide + 0.3, 7.0))), layout="constrained"
    )
    panel = figure.subplots()
    show_map(panel, _backdrop(ground), (wide, high))
    names = contender_names(rows[list(NAMING)].to_dict("records"))
    colours = condition_colours(list(rows["planner"]))
    for place, (row, track) in enumerate(zip(rows.to_dict("records"), tracks, strict=True)):
        # Later ones are smaller, so that paths and ends that coincide are all seen.
        smaller = 1 - place / max(len(rows), 2)
        style = _PATH_STYLES[place // len(set(colours)) % len(_PATH_STYLES)]
        label = f"{names[place]}: {outcome_in_words(row['outcome'])}, {row['end_time_s']:.0f} s"
        draw_edged(panel, track, 0.9 + 2.2 * smaller, colours[place], ls=style, label=label)
        if not row["success"]:
            mark(panel, "end", track[-1], 0.6 + smaller, color=colours[place])
    mark(panel, "start", tracks[0][0], label="start")
    mark(panel, "goal", ground.goal_m, label="goal")
    more: list[Artist] = []
    if not rows["success"].all():
        more.append(mark_handle("end", "end of a failure, in the colour of its path"))
    if ground.immobilising.any():
        more.append(Patch(color=unit(IMMOBILISING), label="immobilises a robot"))
    title = "terrain, faded" if ground.field is None else "λ as it was: the lighter the faster"
    panel.set(xlim=(0, wide), ylim=(0, high), aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)
    thin_ticks(panel)
    figure.legend(handles=[*panel.get_legend_handles_labels()[0], *more], loc="outside right upper")
    return figure


def _backdrop(ground: DrivenGround) -> np.ndarray:
    """Colours in [0, 1] that paths stand out from, shape [H, W, 3]."""
    if ground.field is None:
        return 0.4 * np.moveaxis(ground.rgb, 0, -1) / 255 + 0.6
    grey = _DARKEST + (1 - _DARKEST) * np.repeat(ground.field[..., None], 3, axis=-1)
    grey[ground.immobilising] = unit(IMMOBILISING)
    return grey


@styled()
def failure_figure(lines: Sequence[FailedLine]) -> Figure:
    """Draws a sheet of failures, a line a condition: what was predicted, the path driven on it, and where it ended.

    Args:
        lines: one or more.
    """
    across = max(len(line.failures) for line in lines)
    height, width = lines[0].ground.predicted.shape[1:]
    page = TWO_COLUMNS_IN if across > 2 else ONE_COLUMN_IN
    tall = page / (across + 0.9) * min(height / width, 2.0) + 0.4
    figure = Figure(figsize=(page, tall * len(lines) + 0.6), layout="constrained")
    panels = figure.subplots(len(lines), across, squeeze=False)
    for panel in panels.flat:
        panel.set_visible(False)
    for row_of_panels, line in zip(panels, lines, strict=True):
        predicted = line.ground.told(line.failures[["x_m", "y_m"]].to_numpy())
        for place, row in enumerate(line.failures.to_dict("records")):
            panel = row_of_panels[place]
            _draw_failure(panel, line, place)
            words = ["outside the map" if np.isnan(predicted[place]) else f"λ̂ = {predicted[place]:.2f}"]
            if not np.isnan(row["last_traversability"]):
                words.append(f"observed λ = {row['last_traversability']:.2f}")
            ended = f"{outcome_in_words(row['outcome'])}, {row['end_time_s']:.0f} s"
            panel.set_title(f"{row['scenario']} {row['map']}: {ended}\n{', '.join(words)}", fontsize="small")
        row_of_panels[0].set_ylabel(
            f"{line.name}\n({len(line.failures)} of {line.among} failures)", fontsize="small"
        )
    figure.colorbar(panels[0, 0].images[0], ax=panels, fraction=0.03, aspect=30, label="predicted λ̂")
    more: list[Artist] = []
    if any(line.ground.immobilising.any() for line in lines):
        more.append(Patch(color=unit(IMMOBILISING), label="ground that immobilises a robot"))
    legend_outside(figure, more, 5 if across > 2 else 3)
    return figure


def _draw_failure(panel: Axes, line: FailedLine, place: int) -> None:
    ground, track = line.ground, line.tracks[place]
    height, width = (count * ground.resolution_m for count in ground.predicted.shape[1:])
    panel.set_visible(True)
    show_map(panel, ground.predicted[place], (width, height), **_LAMBDA)
    if ground.immobilising[place].any():
        immobilising = np.zeros((*ground.immobilising.shape[1:], 4))
        immobilising[ground.immobilising[place]] = [*unit(IMMOBILISING), 0.75]
        show_map(panel, immobilising, (width, height))
    draw_edged(panel, track, 1.1, label="driven")
    for name, position in (("start", track[0]), ("goal", ground.goal_m[place]), ("end", track[-1])):
        mark(panel, name, position, 0.9, label=name)
    panel.spines[:].set_visible(False)
    panel.set(xlim=(0, width), ylim=(0, height), xticks=[], yticks=[], aspect="equal")
