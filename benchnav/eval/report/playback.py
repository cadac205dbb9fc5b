"""Recordings of episodes for the Rerun viewer.

A recording holds the terrain as a mesh, colour and risk maps, λ as it was where it stayed so, the robot
at every step, the path driven so far coloured by the λ met, what the planner was thinking, where the robot
was immobilised, and time series; and a blueprint that arranges them.
"""

import re
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path

import matplotlib
import numpy as np

from benchnav.eval.report.drawn_plan import STYLES, DrawnPlan, drawing_interval
from benchnav.eval.report.figures import TRAVERSABILITY_COLOURS
from benchnav.eval.report.ground import SOFT, field_colours, hatching, immobilised_at, outline
from benchnav.eval.report.recording import Recording, take_snapshot
from benchnav.files import replacing
from benchnav.terrain import Grid

APPLICATION = "benchnav"
TIMELINE = "time"

_LIFT_M = 0.12
_RADIUS_M, _RADIUS_PIXELS = 0.02, 0.06
# What keeps long episodes of planners with many thoughts within 3 MB: plans drawn until a new piece of the
# driven path is begun, and points of a layer of a plan.
_PIECE, _MOST_POINTS = 20, 256
# An X in one stroke, and its half width.
_CROSS = np.array([(-1, -1), (1, 1), (0, 0), (-1, 1), (1, -1)], dtype=np.float32)
_CROSS_M = 1.0
_MARK, _EDGE, _HELD = (255, 255, 255), (0, 0, 0), "immobilised"


def playback_path(folder: Path, stem: str, suffix: str = ".rrd") -> Path:
    """Where an episode's recording lies in a run folder.

    The viewer names what it opens by the file, and takes letters, digits, `_` and `-` without a warning;
    all else in the stem becomes `-`.

    Args:
        folder: the run folder.
        stem: names the episode, unlike any other of the run.
        suffix: `.rrd` of the recording, `.npz` of the snapshot.
    """
    return folder / "playback" / f"{_plain(stem)}{suffix}"


def write_playback(folder: Path, stem: str, recording: Recording) -> Path:
    """Writes an episode's recording and, for the figure of trajectories, its snapshot.

    Args:
        folder: the run folder.
        stem: names the episode, unlike any other of the run.
        recording: what to write.

    Returns:
        The recording's path, that of `playback_path`.
    """
    path = playback_path(folder, stem)
    take_snapshot(recording).save(playback_path(folder, stem, ".npz"))
    write_recording(recording, path)
    return path


def write_recording(recording: Recording, path: Path) -> None:
    """Writes an `.rrd` file, whole or not at all.

    Args:
        recording: what to write.
        path: file to write.
    """
    import rerun as rr

    # Written in pieces by their size alone: by the clock, a busy machine would make many small ones of them.
    pieces = rr.ChunkBatcherConfig.DEFAULT()
    pieces.flush_tick = timedelta(hours=1)
    stream = rr.RecordingStream(APPLICATION, recording_id=_plain(path.stem), batcher_config=pieces)
    with replacing(path) as partial:
        stream.save(partial, default_blueprint=arrange(recording))
        try:
            stream.send_recording_name(recording.title)
            _log_terrain(stream, recording)
            _log_robot(stream, recording)
            _log_driven(stream, recording)
            for plan in recording.own_plans:
                _log_plan(stream, recording, plan)
            _log_immobilised(stream, recording)
            stream.flush()
        finally:
            stream.disconnect()


def read_path(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads the robot's path back from a recording.

    Args:
        path: an `.rrd` file.

    Returns:
        Times in seconds, shape [N + 1], and positions (x, y, z) in metres, float32, shape [N + 1, 3].
    """
    from rerun.chunk import RrdReader

    times, positions = [], []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path != "/world/robot" or TIMELINE not in chunk.timeline_names:
            continue
        batch = chunk.to_record_batch()
        column = next(name for name in batch.schema.names if name.endswith("positions"))
        times.append(batch.column(TIMELINE).to_numpy(zero_copy_only=False).astype("timedelta64[ns]"))
        positions += [row[0] for row in batch.column(column).to_pylist()]
    when = np.concatenate(times).astype(np.int64) * 1e-9
    order = np.argsort(when, kind="stable")
    return when[order], np.asarray(positions, dtype=np.float32)[order]


def arrange(recording: Recording):  # type: ignore[no-untyped-def]
    """Arranges the views of a recording, as a blueprint of Rerun's."""
    import rerun.blueprint as rrb

    layers = {"Colour": ["/map/colour", "/map/soft/**"], "Traversability the planner is given": ["/map/risk"]}
    if recording.field is not None:
        layers["Traversability as it is"] = ["/map/field"]
    flat = [
        rrb.Spatial2DView(name=name, origin="/map", contents=[*shown, "/map/overlay/**"])
        for name, shown in layers.items()
    ]
    series = [
        rrb.TimeSeriesView(
            name="Traversability λ", origin="/series/traversability", axis_y=rrb.ScalarAxis(range=(0, 1))
        ),
        rrb.TimeSeriesView(name="Commanded", origin="/series/command"),
        rrb.TimeSeriesView(name="Distance to the goal [m]", origin="/series/goal"),
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(name=recording.title, origin="/world"),
                rrb.Horizontal(*series),
                row_shares=[3, 1],
            ),
            rrb.Vertical(*flat),
            column_shares=[len(flat), 1],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


def _log_terrain(stream, recording: Recording) -> None:  # type: ignore[no-untyped-def]
    import rerun as rr

    grid = recording.grid
    rows, columns = np.mgrid[: grid.height, : grid.width]
    vertices = np.stack(
        ((columns + 0.5) * grid.resolution_m, (rows + 0.5) * grid.resolution_m, recording.elevation_m),
        axis=-1,
    )
    corner = (rows * grid.width + columns)[:-1, :-1].ravel()
    right, above = corner + 1, corner + grid.width
    triangles = np.concatenate(
        (np.stack((corner, right, above), axis=1), np.stack((right, above + 1, above), axis=1))
    )
    image = np.moveaxis(recording.rgb, 0, -1)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log(
        "world/terrain",
        rr.Mesh3D(
            vertex_positions=vertices.reshape(-1, 3),
            triangle_indices=triangles,
            vertex_colors=image.reshape(-1, 3),
        ),
        static=True,
    )
    # Images have their first row at the top, maps at the bottom.
    stream.log("map/colour", rr.Image(image[::-1]), static=True)
    shades = matplotlib.colormaps[TRAVERSABILITY_COLOURS](recording.predicted[::-1])[..., :3]
    shades[~recording.free[::-1]] = 0.25
    stream.log("map/risk", rr.Image(np.round(255 * shades).astype(np.uint8)), static=True)
    if recording.field is not None:
        field = field_colours(recording.field, recording.holding)
        stream.log("map/field", rr.Image(field[::-1]), static=True)
    if recording.soft.any():
        for name, lines in (("outline", outline), ("hatching", hatching)):
            drawn = lines(recording.soft, grid.resolution_m)
            flat = _flat(grid, drawn.reshape(-1, 2)).reshape(-1, 2, 2)
            stream.log(f"map/soft/{name}", rr.LineStrips2D(flat, colors=[SOFT], radii=0.06), static=True)
    for name, position, colour in (
        ("start", recording.states[0, :2], (230, 30, 30)),
        ("goal", recording.goal_m, (255, 0, 255)),
    ):
        place = position[None].astype(np.float32)
        stream.log(
            f"world/{name}", rr.Points3D(_lift(recording, place), radii=0.35, colors=[colour]), static=True
        )
        stream.log(
            f"map/overlay/{name}", rr.Points2D(_flat(grid, place), radii=0.7, colors=[colour]), static=True
        )


def _log_robot(stream, recording: Recording) -> None:  # type: ignore[no-untyped-def]
    import rerun as rr

    states = recording.states
    steps = np.arange(len(states))
    times = rr.TimeColumn(TIMELINE, duration=steps * recording.dt_s)
    place = states[:, :2].astype(np.float32)
    lifted = _lift(recording, place)
    heading = np.stack((np.cos(states[:, 2]), np.sin(states[:, 2]), np.zeros(len(states))), axis=1)
    robot = [(0, 170, 0)] * len(states)
    stream.send_columns("world/robot", [times], rr.Points3D.columns(positions=lifted, colors=robot))
    stream.log("world/robot", rr.Points3D.from_fields(radii=[0.3]), static=True)
    stream.send_columns(
        "world/heading", [times], rr.Arrows3D.columns(origins=lifted, vectors=1.2 * heading, colors=robot)
    )
    stream.send_columns(
        "map/overlay/robot",
        [times],
        rr.Points2D.columns(positions=_flat(recording.grid, place), colors=robot),
    )
    stream.log("map/overlay/robot", rr.Points2D.from_fields(radii=[0.7]), static=True)
    predicted = recording.predicted[_cells(recording.grid, place)]
    series = {
        "traversability/met": recording.traversability,
        "traversability/predicted": predicted[:-1],
        "goal/distance": np.linalg.norm(place - recording.goal_m, axis=1)[:-1],
    }
    for name, commanded in zip(recording.action_names, recording.actions.T, strict=True):
        series[f"command/{rr.escape_entity_path_part(name)}"] = commanded
    acting = rr.TimeColumn(TIMELINE, duration=steps[:-1] * recording.dt_s)
    for name, values in series.items():
        stream.send_columns(f"series/{name}", [acting], rr.Scalars.columns(scalars=values.astype(np.float64)))


def _log_driven(stream, recording: Recording) -> None:  # type: ignore[no-untyped-def]
    import rerun as rr

    place = recording.states[:, :2].astype(np.float32)
    lifted, flat = _lift(recording, place), _flat(recording.grid, place)
    shades = matplotlib.colormaps[TRAVERSABILITY_COLOURS](recording.traversability)[:, :3]
    colours = np.round(255 * shades).astype(np.uint8)
    count, every = len(recording.traversability), drawing_interval(recording.dt_s)
    # Piece by piece, since each time all of a piece is logged.
    for piece, first in enumerate(range(0, count, _PIECE * every)):
        last = min(first + _PIECE * every, count)
        for step in [*range(first + every, last, every), last]:
            stream.set_time(TIMELINE, duration=step * recording.dt_s)
            for name, points, kind, radius in (
                ("world", lifted, rr.LineStrips3D, 0.08),
                ("map/overlay", flat, rr.LineStrips2D, 0.25),
            ):
                segments = np.stack((points[first:step], points[first + 1 : step + 1]), axis=1)
                stream.log(
                    f"{name}/driven/{piece:03}", kind(segments, colors=colours[first:step], radii=radius)
                )


def _log_plan(stream, recording: Recording, plan: DrawnPlan) -> None:  # type: ignore[no-untyped-def]
    import rerun as rr

    stream.set_time(TIMELINE, duration=plan.step * recording.dt_s)
    for name, style in STYLES.items():
        lines, colours = _thinned(plan.lines.get(name, ())), [style.colour]
        lifted = [_lift(recording, line) for line in lines]
        flat = [_flat(recording.grid, line) for line in lines]
        thick, thick_flat = _RADIUS_M * style.width, _RADIUS_PIXELS * style.width
        # A layer without lines is logged too: it wipes out the earlier plan's.
        stream.log(f"world/plan/{name}", rr.LineStrips3D(lifted, colors=colours, radii=thick))
        stream.log(f"map/overlay/plan/{name}", rr.LineStrips2D(flat, colors=colours, radii=thick_flat))


def _thinned(lines: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Leaves out points within lines, alike in all of them, where a layer has too many."""
    points = sum(len(line) for line in lines)
    every = -(-points // _MOST_POINTS)
    return [np.concatenate((line[:-1:every], line[-1:])) for line in lines]


def _log_immobilised(stream, recording: Recording) -> None:  # type: ignore[no-untyped-def]
    """Marks where the robot was held, from that moment on."""
    import rerun as rr

    place = immobilised_at(recording.about, recording.states[:, :2])
    if place is None:
        return
    stream.set_time(TIMELINE, duration=len(recording.traversability) * recording.dt_s)
    cross = place + _CROSS_M * _CROSS
    flat, lifted = _flat(recording.grid, cross), _lift(recording, cross)
    lifted[:, 2] += 0.3
    for name, mark in (
        ("world/immobilised", rr.LineStrips3D([lifted], colors=[_MARK], radii=0.12, labels=[_HELD])),
        ("map/overlay/immobilised/edge", rr.LineStrips2D([flat], colors=[_EDGE], radii=0.55, draw_order=40)),
        (
            "map/overlay/immobilised/cross",
            rr.LineStrips2D([flat], colors=[_MARK], radii=0.3, draw_order=41, labels=[_HELD]),
        ),
    ):
        stream.log(name, mark)


def _cells(grid: Grid, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cell = np.floor(place / grid.resolution_m).astype(int)
    return cell[:, 1].clip(0, grid.height - 1), cell[:, 0].clip(0, grid.width - 1)


def _lift(recording: Recording, place: np.ndarray) -> np.ndarray:
    """Puts positions a little over the ground; x and y stay as they are."""
    height = recording.elevation_m[_cells(recording.grid, place)] + _LIFT_M
    return np.concatenate((place, height[:, None]), axis=1).astype(np.float32)


def _flat(grid: Grid, place: np.ndarray) -> np.ndarray:
    """Puts positions on the images."""
    return np.stack((place[:, 0] / grid.resolution_m, grid.height - place[:, 1] / grid.resolution_m), axis=1)


def _plain(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text).strip("-") or "episode"
