"""Figures on the maps of a run: trajectories (after the paper's Fig. 2), whole driven paths, and failures."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, to_rgb, to_rgba
from matplotlib.figure import Figure

from benchnav.core.figures import (
    ONE_COLUMN_IN,
    TRAVERSABILITY_COLOURS,
    TWO_COLUMNS_IN,
    condition_colours,
    draw_edged,
    frame_map,
    legend_outside,
    line_style,
    mark,
    mark_handle,
    robot_marker,
    show_map,
    stack_panels,
    styled,
)
from benchnav.eval.experiment.condition import KNOWLEDGE, NOT_USED
from benchnav.eval.folder.steps import STEPS, read_steps
from benchnav.eval.recording import GROUND, Ground, Recording
from benchnav.eval.report.failures import FailedLine
from benchnav.eval.report.plan_layers import (
    CLOSED,
    IMMOBILISING,
    SOFT,
    STYLES,
    draw_driven,
    draw_soft,
    driven_path,
    end_cell_handle,
    end_mark,
    field_colours,
    mark_end,
    plan_layer,
)
from benchnav.eval.report.words import NAMING, condition_name, contender_names, differ, outcome_in_words

MOST_PANELS = 4
_PANELS_A_LINE = 4
_LETTER_IN = 0.048
_SAME_MAP = ["data", "scenario", "map", "seed", "realisation"]
_LIGHT = 0.5  # opacity of a map under marks and dark red
_DARKEST = 0.35  # grey of λ = 0
_LAMBDA: dict[str, Any] = {"cmap": TRAVERSABILITY_COLOURS, "vmin": 0, "vmax": 1}
_HOLDS = {"label": "immobilises a robot", "color": IMMOBILISING}


def choose_recordings(recordings: Sequence[Recording], conditions: Sequence[str]) -> list[Recording]:
    """Chooses one recording a condition, all of one map where there are such, at most `MOST_PANELS`.

    Of the maps that the first condition was recorded on it is the first on which outcomes differ, if there is one;
    else the first on which an episode failed.

    Args:
        recordings: all there are.
        conditions: ids in the order wanted.
    """
    table = pd.DataFrame(
        [recording.about for recording in recordings], columns=["condition", "outcome", *_SAME_MAP]
    )
    table = table.astype({"condition": pd.CategoricalDtype(conditions), "map": int})
    table = table.dropna(subset="condition").sort_values(["condition", "map"], kind="stable")
    if table.empty:
        return []
    maps = table.groupby(_SAME_MAP)
    table["differing"] = maps["outcome"].transform("nunique") > 1
    table["failed"] = maps["outcome"].transform(lambda outcomes: set(outcomes) != {"success"})
    firsts = table[table["condition"] == table["condition"].iloc[0]]
    shown = firsts.sort_values(["differing", "failed"], ascending=False, kind="stable").iloc[0]
    table["other"] = (table[_SAME_MAP] != shown[_SAME_MAP]).any(axis=1)
    chosen = table.sort_values(["condition", "other"], kind="stable").drop_duplicates("condition")
    return [recordings[place] for place in chosen.index[:MOST_PANELS]]


@styled()
def trajectory_figure(recordings: Sequence[Recording]) -> Figure:
    """Draws episodes at one moment side by side: the terrain above with what was planned, the map planned on below.

    Where λ stayed what it was through an episode, a third row shows it, with the whole driven path.

    Args:
        recordings: at least one.
    """
    lines = -(-len(recordings) // _PANELS_A_LINE)
    across = -(-len(recordings) // lines)  # as full as lines can be
    layers = 2 if all(recording.field is None for recording in recordings) else 3
    width = ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN
    panel_in = (width - 0.9) / across - 0.1
    tallest = max(recording.grid.height / recording.grid.width for recording in recordings)
    tall = panel_in * min(max(tallest, 0.3), 2.0) + 0.35
    figure = Figure(figsize=(width, (layers * tall + 0.2) * lines + 0.8), layout="compressed")
    stacks = stack_panels(figure, len(recordings), across, layers)
    several = [
        name
        for name in ("model", *KNOWLEDGE, "world")
        if differ(one.about.get(name, NOT_USED) for one in recordings)
    ]
    maps = [f"{one.about['scenario']}, map {one.about['map']}" for one in recordings]
    letters = int(panel_in / _LETTER_IN)
    for place, (recording, (above, below, *last)) in enumerate(zip(recordings, stacks, strict=True)):
        about, plan, now = recording.about, recording.plan, recording.now
        heading = condition_name(about, several) + (f", {maps[place]}" if len(set(maps)) > 1 else "")
        has_ended = now == len(recording.traversability)
        moment = f"{recording.outcome} after {recording.end_s:g} s"
        if not has_ended:
            moment = f"t = {now * recording.dt_s:g} s; {moment}"
        driven = _draw_terrain(above, recording)
        above.set_title(f"{heading}\n{moment}")
        _draw_predicted(below, recording)
        for panel in (above, below):
            for name, style in STYLES.items():
                if len(plan.lines.get(name, ())):
                    panel.add_collection(plan_layer(style, plan.lines[name]))
            _mark_places(panel, recording)
            if has_ended:
                _mark_end(panel, recording)
            else:
                turned = robot_marker(recording.states[now, 2])
                mark(panel, "robot", recording.track[now], marker=turned)
        if recording.field is not None:
            _draw_field(last[0], recording, recording.field)
        elif last:
            last.pop().remove()
        drawn = [above, below, *last]
        drawn[-1].set_xlabel("x [m]")
        for panel in drawn:
            panel.tick_params(labelleft=place % across == 0, labelbottom=panel is drawn[-1])
            panel.set_ylabel("y [m]" if place % across == 0 else "")
            # Broken where it is wider than the panel.
            title = (textwrap.fill(line, letters) for line in panel.get_title().splitlines())
            panel.set_title("\n".join(title), fontsize="small")
    ended = any(own.field is not None or own.now == len(own.traversability) for own in recordings)
    legend_outside(figure, [end_cell_handle()] if ended else [], columns=1 if across == 1 else 4)
    shrink = min(1.0, 4 / figure.get_figheight())
    figure.colorbar(
        driven,
        ax=figure.axes,
        fraction=0.03,
        aspect=40,
        shrink=shrink,
        anchor=(0, 1),
        label="traversability λ",
    )
    return figure


def _draw_terrain(panel: Axes, recording: Recording) -> LineCollection:
    """Draws the terrain, and the path driven by that moment, coloured by the observed λ."""
    show_map(panel, np.moveaxis(recording.rgb, 0, -1), recording.grid.extent_m)
    if recording.field is not None and recording.soft.any():
        draw_soft(panel, recording.soft, recording.resolution_m)
        _name_ground(panel, "soft ground, which does not show", fc="0.45", ec=SOFT, hatch="////")
    driven = recording.track[: recording.now + 1]
    coloured = driven_path(2)
    draw_driven(coloured, driven, recording.traversability)
    coloured.set_zorder(2.5)
    panel.plot(*driven.T, color="white", lw=3.2, solid_capstyle="round")
    panel.add_collection(coloured)
    return coloured


def _draw_predicted(panel: Axes, recording: Recording) -> None:
    """Draws the λ̂ that the planner had by that moment, and the path in black, since the map has the colours of λ."""
    predicted, free = recording.given_at(recording.now)
    show_map(panel, predicted, recording.grid.extent_m, **_LAMBDA)
    if not free.all():
        closed = np.where(free, np.nan, 1.0)
        show_map(panel, closed, recording.grid.extent_m, cmap=ListedColormap([CLOSED]))
        _name_ground(panel, "not free", color=CLOSED)
    title = "λ̂ given to the planner"
    if recording.about["model"] == NOT_USED:
        title = "true E[λ]; the planner uses no map"
    elif recording.known:
        title = "λ̂ known by then"
    elif (recording.about.get("sensor", "full"), recording.about.get("belief", "static")) != (
        "full",
        "static",
    ):
        title = "λ̂ at the start"  # what was learnt was not recorded
    panel.set_title(title)
    words = "driven; above in the colour of the observed λ"
    draw_edged(panel, recording.track[: recording.now + 1], 1.4, label=words)


def _draw_field(panel: Axes, recording: Recording, field: np.ndarray) -> None:
    """Draws the λ field, and the whole driven path over it."""
    colours = field_colours(field, recording.immobilising)
    show_map(panel, colours, recording.grid.extent_m)
    draw_edged(panel, recording.track, 1.4)
    _mark_places(panel, recording)
    _mark_end(panel, recording, ground=colours)
    if recording.immobilising.any():
        _name_ground(panel, **_HOLDS)
    panel.set_title("whole path, over the λ field")


def _mark_places(panel: Axes, recording: Recording) -> None:
    """Marks start and goal."""
    for name, place in (("start", recording.track[0]), ("goal", recording.goal_m)):
        mark(panel, name, place)
    frame_map(panel)


def _mark_end(panel: Axes, recording: Recording, ground: np.ndarray | None = None) -> None:
    """Marks how an episode ended."""
    outcome, track = recording.about["outcome"], recording.track
    mark_end(panel, outcome, track, recording.goal_m, recording.resolution_m, ground=ground)


def _name_ground(panel: Axes, label: str, **look: Any) -> None:
    """Lets the legend name a kind of ground, of which images have no entry."""
    panel.fill([], [], label=label, **look)


def read_driven(folder: Path, episodes: pd.DataFrame) -> tuple[Ground, pd.DataFrame, list[np.ndarray]] | None:
    """Reads whole driven paths on the map that a run kept; nothing where it kept none, or no steps.

    Args:
        folder: a finished run.
        episodes: its rows.

    Returns:
        The map; of each condition its episode there; and the driven positions of each, shape [N + 1, 2].
    """
    path = folder / GROUND
    if not path.exists() or not (folder / STEPS).is_dir():
        return None
    ground = Ground.load(path)
    rows = episodes[(episodes[list(ground.about)] == pd.Series(ground.about)).all(axis=1)]
    place = {name: ground.about[name] for name in ("seed", "realisation", "map")}
    steps = read_steps(folder, condition=list(rows["condition"]), **place).groupby("condition")
    rows = rows[rows["condition"].isin(steps.groups)]
    tracks = [steps.get_group(condition)[["x_m", "y_m"]].to_numpy() for condition in rows["condition"]]
    return (ground, rows, tracks) if tracks else None


@styled()
def driven_figure(ground: Ground, rows: pd.DataFrame, tracks: Sequence[np.ndarray]) -> Figure:
    """Draws whole driven paths over the λ field, or over faded terrain where it was resampled.

    Args:
        ground: the map.
        rows: an episode a condition, one or more.
        tracks: positions of each, shape [N + 1, 2].
    """
    high, wide = ground.grid.shape
    # The legend stands below, a line a path.
    width = ONE_COLUMN_IN if wide < 2 * high else TWO_COLUMNS_IN
    tall = min(width * high / wide, 7.0) + 0.15 * (len(rows) + 4) + 0.4
    figure = Figure(figsize=(width, tall), layout="compressed")
    panel = figure.subplots()
    show_map(panel, _backdrop(ground), ground.grid.extent_m)
    names = contender_names(rows[[name for name in NAMING if name in rows]].to_dict("records"))
    colours, failed = condition_colours(list(rows["planner"])), dict[str, None]()
    for place, (row, track) in enumerate(zip(rows.to_dict("records"), tracks, strict=True)):
        # Later ones are smaller, so that paths and ends that coincide are all seen.
        smaller = 1 - place / max(len(rows), 2)
        label = f"{names[place]}: {outcome_in_words(row['outcome'])}, {row['end_time_s']:.0f} s"
        draw_edged(panel, track, 0.9 + 2.2 * smaller, colours[place], ls=line_style(place), label=label)
        if not row["success"]:
            looks: dict[str, Any] = {"color": colours[place], "label": ""}
            mark_end(
                panel, row["outcome"], track, ground.goal_m, ground.resolution_m, 0.6 + 0.6 * smaller, **looks
            )
            failed[end_mark(row["outcome"])] = None
    mark(panel, "start", tracks[0][0])
    mark(panel, "goal", ground.goal_m)
    if ground.immobilising.any():
        _name_ground(panel, **_HOLDS)
    title = "terrain, faded" if ground.field is None else "λ field of the episode; lighter is higher"
    panel.set(xlabel="x [m]", ylabel="y [m]", title=title)
    frame_map(panel)
    ends: list[Artist] = [mark_handle(name) for name in failed]
    for handle in ends:
        handle.set_label(f"{handle.get_label()}, in the colour of its path")
    if ends:
        ends.append(end_cell_handle())
    legend_outside(figure, ends, columns=1 if width == ONE_COLUMN_IN else 2)
    return figure


def _backdrop(ground: Ground) -> np.ndarray:
    """Colours in [0, 1] that paths stand out from, shape [H, W, 3]."""
    if ground.field is None:
        return 0.4 * np.moveaxis(ground.rgb, 0, -1) / 255 + 0.6
    grey = _DARKEST + (1 - _DARKEST) * np.repeat(ground.field[..., None], 3, axis=-1)
    grey[ground.immobilising] = to_rgb(IMMOBILISING)
    return grey


@styled()
def failure_figure(lines: Sequence[FailedLine]) -> Figure:
    """Draws a sheet of failures, a line a condition: what was predicted, the path driven on it, and where it ended.

    Args:
        lines: one or more.
    """
    across = max(len(line.recordings) for line in lines)
    height, width = lines[0].recordings[0].grid.shape
    page = TWO_COLUMNS_IN if across > 2 else ONE_COLUMN_IN
    tall = page / (across + 0.9) * min(height / width, 2.0) + 0.4
    figure = Figure(figsize=(page, tall * len(lines) + 0.6), layout="constrained")
    panels = figure.subplots(len(lines), across, squeeze=False)
    for panel in panels.flat:
        panel.set_visible(False)
    for row_of_panels, line in zip(panels, lines, strict=True):
        shown = zip(row_of_panels, line.recordings, line.failures.to_dict("records"), strict=False)
        for panel, recording, row in shown:
            _draw_failure(panel, recording, row["outcome"])
            predicted = recording.predicted_at_end
            words = ["outside the map" if np.isnan(predicted) else f"λ̂ = {predicted:.2f}"]
            if not np.isnan(row["last_traversability"]):
                words.append(f"observed λ = {row['last_traversability']:.2f}")
            ended = f"{outcome_in_words(row['outcome'])}, {row['end_time_s']:.0f} s"
            panel.set_title(
                f"{row['scenario']}, map {row['map']}: {ended}\n{', '.join(words)}", fontsize="small"
            )
        count = f"({len(line.failures)} of {line.among} failures)"
        row_of_panels[0].set_ylabel(f"{line.name}\n{count}", fontsize="small")
    figure.colorbar(panels[0, 0].images[0], ax=panels, fraction=0.03, aspect=30, label="predicted λ̂")
    legend_outside(figure, [end_cell_handle()], columns=6 if across > 2 else 3)
    return figure


def _draw_failure(panel: Axes, recording: Recording, outcome: str) -> None:
    panel.set_visible(True)
    show_map(panel, recording.predicted, recording.grid.extent_m, alpha=_LIGHT, **_LAMBDA)
    if recording.immobilising.any():
        colours = np.zeros((*recording.grid.shape, 4))
        colours[recording.immobilising] = to_rgba(IMMOBILISING, 0.75)
        show_map(panel, colours, recording.grid.extent_m)
        _name_ground(panel, **_HOLDS)
    track = recording.track
    draw_edged(panel, track, 1.1, label="driven")
    for name, position in (("start", track[0]), ("goal", recording.goal_m)):
        mark(panel, name, position, 0.9)
    mark_end(panel, outcome, track, recording.goal_m, recording.resolution_m, 0.9)
    panel.spines[:].set_visible(False)
    panel.set(xticks=[], yticks=[])
