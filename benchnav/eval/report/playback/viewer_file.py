"""Files for the Rerun viewer: one episode, or several on one map.

A file contains the terrain as a mesh, maps (colour, layers, true mean of λ, λ field),
the λ̂ and the plans of each planner, each robot with heading, driven path and outcome,
time series, and a blueprint that arranges these contents. For a robot that learns, it
also contains the belief, the observed and measured cells and the sensors' footprint,
all over time. A robot with a footprint has contacts, and a rigid body its wheels,
chassis and ruts.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from benchnav.core.grid import is_azimuth
from benchnav.core.store import replacing
from benchnav.core.tables import Bold, Table, to_markdown
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.folder.checksums import matches_checksum, note_checksums
from benchnav.eval.recording import Recording
from benchnav.eval.report.playback.bodies import RUTS, log_body
from benchnav.eval.report.playback.scene import (
    TIMELINE,
    Driver,
    Stage,
    layer_entity,
    log_driver,
    log_terrain,
)
from benchnav.eval.words import NAMING, contender_names, display_name
from benchnav.viz.maps import MAX_SPREAD, layer_scale
from benchnav.viz.style import bytes_of, condition_colours

APPLICATION = "benchnav"

_SINGLE_COLOUR = "#00aa00"  # colour of a single robot
# Titles of views of a learning robot's maps, by name of the map.
_LEARNT = {
    "mean": "Belief: mean of λ",
    "spread": f"Belief: spread of λ, 0 to {MAX_SPREAD:g}",
    "seen": "Observed cells light, measured λ blue",
}
_OVERLAY = "/map/overlay/**"
_START_AND_GOAL = "/map/places/**"


def write_viewer_files(folder: Path) -> None:
    """Write missing and damaged viewer files of the recordings in a run folder.

    Args:
        folder: the run folder.
    """
    files = []
    for stored in sorted((folder / "playback").glob("*.npz")):
        file = stored.with_suffix(".rrd")
        files.append(file)
        if not file.exists() or not matches_checksum(folder, file):
            write_rerun([Recording.load(stored)], file)
    note_checksums(folder, files)


def write_rerun(recordings: Sequence[Recording], path: Path) -> None:
    """Write an `.rrd` file atomically.

    Args:
        recordings: one recording, or several on one map.
        path: path of the file; the viewer shows its name.
    """
    drivers = drivers_of(recordings)
    # Each entity is one chunk, since the header of a chunk has more than a kilobyte.
    batches = rr.ChunkBatcherConfig.NEVER()
    stream = rr.RecordingStream(
        APPLICATION, recording_id=path.stem, batcher_config=batches
    )
    with replacing(path) as partial:
        stream.save(partial, default_blueprint=arrange(drivers))
        try:
            stream.send_recording_name(_title(drivers))
            text = rr.TextDocument(describe(drivers), media_type="text/markdown")
            stream.log("about", text, static=True)
            log_terrain(Stage(stream=stream, recording=recordings[0]))
            for driver in drivers:
                log_driver(stream, driver)
                log_body(stream, driver)
            stream.flush()
        finally:
            stream.disconnect()


def drivers_of(recordings: Sequence[Recording]) -> list[Driver]:
    """Return drivers with unique names and colours; a single driver has no name."""
    if len(recordings) == 1:
        return [
            Driver(recording=recordings[0], name="", colour=bytes_of(_SINGLE_COLOUR))
        ]
    labels = [recording.about for recording in recordings]
    names = contender_names(labels)
    colours = condition_colours([row["planner"] for row in labels])
    drivers = []
    for recording, name, colour in zip(recordings, names, colours, strict=True):
        driver = Driver(recording=recording, name=name, colour=bytes_of(colour))
        drivers.append(driver)
    return drivers


def _title(drivers: Sequence[Driver]) -> str:
    if len(drivers) == 1:
        return drivers[0].recording.title
    labels = drivers[0].recording.about
    names = ", ".join(driver.name for driver in drivers)
    return f"{labels['scenario']} {labels['map']}: {names}"


def arrange(drivers: Sequence[Driver]) -> Any:
    """Return the blueprint: terrain and time series on the left, maps on the right."""
    series = [
        rrb.TimeSeriesView(
            name="Observed λ",
            origin="/series/traversability",
            axis_y=rrb.ScalarAxis(range=(0, 1)),
        ),
        rrb.TimeSeriesView(name="Distance to the goal [m]", origin="/series/goal"),
    ]
    title = "All conditions"
    if len(drivers) == 1:
        title = drivers[0].recording.title
        commands = rrb.TimeSeriesView(name="Commanded speeds", origin="/series/command")
        series.insert(1, commands)
    if any(driver.recording.ruts_m is not None for driver in drivers):
        ruts = rrb.TimeSeriesView(name="Depth of ruts [cm]", origin=f"/{RUTS}")
        series.insert(1, ruts)
    terrain = rrb.Spatial3DView(name=title, origin="/world")
    description = rrb.TextDocumentView(name="About", origin="/about")
    below = rrb.Horizontal(*series, description)
    scene = rrb.Vertical(terrain, below, row_shares=[3, 1])
    maps = [
        rrb.Spatial2DView(name=name, origin="/map", contents=contents)
        for name, contents in map_views(drivers).items()
    ]
    grid = rrb.Grid(*maps, grid_columns=2)
    return rrb.Blueprint(
        rrb.Horizontal(scene, grid, column_shares=[1, 1]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


def map_views(drivers: Sequence[Driver]) -> dict[str, list[str]]:
    """Return the paths of the entities that each view of a map shows, by title."""
    recording = drivers[0].recording
    is_single = len(drivers) == 1
    overlays = [_OVERLAY, _START_AND_GOAL]
    on_truth = ["/map/closed", *overlays] if is_single else overlays
    colour = "Colour, soft terrain hatched" if recording.soft.any() else "Colour"
    views = {colour: ["/map/colour", "/map/soft/**", *overlays]}
    for name, layer in recording.layers.items():
        views[layer_title(name, layer)] = [f"/{layer_entity(name)}", *overlays]
    views["True mean of λ"] = ["/map/true_mean", *on_truth]
    if recording.field is not None:
        title = "λ field of the episode; cells that immobilise a robot in dark red"
        views[title] = ["/map/field", *on_truth]
    for driver in drivers:
        planner = driver.name or "the planner"
        rule = free_rule(driver.recording)
        title = f"λ̂ given to {planner}; cells are free with {rule}"
        overlay = driver.entity("/map/overlay", "**")
        views[title] = [driver.entity("/map/risk"), overlay, _START_AND_GOAL]
    if is_single and recording.known:
        for name, title in _LEARNT.items():
            views[title] = [f"/map/{name}", *overlays]
    return views


def layer_title(name: str, layer: np.ndarray) -> str:
    """Return the title of a layer's view: name and range of the layer."""
    if is_azimuth(name):
        return f"{name}, directions"
    scale = layer_scale(name, layer)
    return f"{name}, {scale['vmin']:.3g} to {scale['vmax']:.3g}"


def describe(drivers: Sequence[Driver]) -> str:
    """Describe the episodes in Markdown: labels, outcomes and rules for free cells."""
    recordings = [driver.recording for driver in drivers]
    rows: dict[str, Sequence[str]] = {}
    for name in NAMING:
        labels = [recording.about.get(name, NOT_USED) for recording in recordings]
        cells = [display_name(name, label) for label in labels]
        if set(cells) != {NOT_USED}:
            rows[name] = cells
    rows["outcome"] = [Bold(recording.outcome) for recording in recordings]
    rows["time"] = [_time_in_words(recording) for recording in recordings]
    observed = [recording.traversability for recording in recordings]
    rows["observed λ"] = list(map(_mean_in_words, observed))
    rows["free cells"] = [free_rule(recording) for recording in recordings]
    names = [driver.name for driver in drivers]
    table = Table(
        headings=("", *names),
        rows=tuple((name, *cells) for name, cells in rows.items()),
    )
    template = (
        "# {data}, {scenario} {map}\n\nSeed {seed}, realisation {realisation}\n\n"
    )
    return template.format(**recordings[0].about) + to_markdown(table)


def _time_in_words(recording: Recording) -> str:
    return f"{recording.end_s:.1f} s of {recording.time_budget_s:g} s"


def _mean_in_words(traversability: np.ndarray) -> str:
    return f"{traversability.mean():.2f}" if len(traversability) else NOT_USED


def free_rule(recording: Recording) -> str:
    """Return the rule for which cells are free, in words."""
    by = "mean λ" if recording.free_by == "mean" else "λ̂"
    return f"{by} above {recording.free_above:g}"
