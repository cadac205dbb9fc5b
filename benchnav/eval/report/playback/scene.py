"""What the Rerun viewer shows: terrain, maps, start and goal; and of each robot where it is, what it planned and met.

Of robots that learn on their way it shows what they knew when, and how far their sensors reached.

The terrain is a mesh under `world`, in metres; maps are images under `map`, in cells, their first row at the
bottom.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from benchnav.core.grid import outline
from benchnav.eval.figures.moment import known_colours, true_colours
from benchnav.eval.recording import Recording, drawing_interval, thinned
from benchnav.viz.maps import (
    MARKS,
    REACH,
    SOFT,
    STYLES,
    hatching,
    layer_colours,
    shades,
)
from benchnav.viz.style import bytes_of

TIMELINE = "time"

_RADIUS_M, _RADIUS_CELLS = 0.02, 0.06
_HEADING_M = 1.2
# Plans drawn until a new piece of the driven path is begun: at each plan all of a piece is logged.
_PIECE = 10
# An X in one stroke, and its half width.
_CROSS = np.array([(-1, -1), (1, 1), (0, 0), (-1, 1), (1, -1)], dtype=np.float32)
_CROSS_M = 1.0
_MARK = (255, 255, 255)
_TRANSLUCENT = 160  # of a plan, in [0, 255]
_LIFT_M = 0.12
_CLOSED = (240, 240, 240)

# Archetypes over the ground and on the maps.
_POINTS, _STRIPS = (rr.Points3D, rr.Points2D), (rr.LineStrips3D, rr.LineStrips2D)


@dataclass(frozen=True, kw_only=True)
class Driver:
    """One robot of a recording.

    Args:
        recording: its episode.
        name: unlike those of the others; empty where it is alone.
        colour: red, green, blue and opacity, in [0, 255].
    """

    recording: Recording
    name: str
    colour: tuple[int, ...]

    def entity(self, root: str, *leaf: str) -> str:
        """Path of what is the robot's own under a root."""
        own = ["conditions", rr.escape_entity_path_part(self.name)] if self.name else []
        return "/".join([root, *own, *leaf])

    def entities(self, leaf: str) -> tuple[str, str]:
        """Paths of what is its own over the ground and on the maps."""
        return self.entity("world", leaf), self.entity("map/overlay", leaf)


def log_ground(stream: Any, recording: Recording) -> None:
    """Logs the ground as a mesh, and the maps that are no planner's own: colour, layers, soft ground, λ in truth."""
    grid = recording.grid
    rows, columns = np.mgrid[: grid.height, : grid.width]
    x_m, y_m = ((cells + 0.5) * grid.resolution_m for cells in (columns, rows))
    corner = (rows * grid.width + columns)[:-1, :-1].ravel()
    right, above = corner + 1, corner + grid.width
    triangles = np.stack((corner, right, above, right, above + 1, above), axis=1).reshape(-1, 3)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    mesh = rr.Mesh3D(
        vertex_positions=np.stack((x_m, y_m, recording.elevation_m), axis=-1).reshape(-1, 3),
        triangle_indices=triangles,
        vertex_colors=recording.rgb.reshape(3, -1).T,
    )
    stream.log("world/terrain", mesh, static=True)
    _log_image(stream, "map/colour", np.moveaxis(recording.rgb, 0, -1))
    for name, layer in recording.layers.items():
        _log_image(stream, layer_entity(name), layer_colours(name, layer))
    _log_image(stream, "map/true_mean", shades(recording.true_mean))
    if recording.field is not None:
        _log_image(stream, "map/field", true_colours(recording))
    if recording.soft.any():
        for name, lines in (("outline", outline), ("hatching", hatching)):
            flat = _on_map(recording, lines(recording.soft, grid.resolution_m))
            strips = rr.LineStrips2D(flat, colors=[bytes_of(SOFT)], radii=0.06)
            stream.log(f"map/soft/{name}", strips, static=True)
    for name, place in (("start", recording.track[0]), ("goal", recording.goal_m)):
        entities, colour = (f"world/{name}", f"map/places/{name}"), bytes_of(MARKS[name]["color"])
        _log_both(stream, recording, entities, _POINTS, [place], (0.35, 0.7), static=True, colors=[colour])


def layer_entity(name: str) -> str:
    """Path of the image of a layer."""
    return f"map/layers/{rr.escape_entity_path_part(name)}"


def log_driver(stream: Any, driver: Driver) -> None:
    """Logs all that is a robot's own."""
    for log in (_log_predicted, _log_robot, _log_series, _log_driven, _log_plans, _log_outcome):
        log(stream, driver)


def _log_predicted(stream: Any, driver: Driver) -> None:
    """Logs the λ̂ that a planner was given, and the edge of ground that is not free; and what it learnt on its way."""
    recording = driver.recording
    if not recording.known:
        _log_image(stream, driver.entity("map/risk"), known_colours(recording, 0)["risk"])
        _log_closed(stream, driver, recording.free)
    for known in recording.known:
        stream.set_time(TIMELINE, duration=known.step * recording.dt_s)
        for name, colours in known_colours(recording, known.step).items():
            _log_image(stream, driver.entity(f"map/{name}"), colours, static=False)
        _log_closed(stream, driver, known.free, static=False)
        look = driver.colour if driver.name else bytes_of(REACH)
        _log_both(
            stream, recording, driver.entities("reach"), _STRIPS, known.outlines, (0.05, 0.15), colors=[look]
        )


def _log_closed(stream: Any, driver: Driver, free: np.ndarray, static: bool = True) -> None:
    """Logs the edge of ground that is not free."""
    recording = driver.recording
    flat = _on_map(recording, outline(~free, recording.resolution_m))
    edge = rr.LineStrips2D(flat, colors=[_CLOSED], radii=0.08)
    stream.log(driver.entity("map/closed"), edge, static=static)


def _log_image(stream: Any, entity: str, image: np.ndarray, static: bool = True) -> None:
    """Logs a map, uint8 of shape [H, W, 3], as an image; images have their first row at the top."""
    stream.log(entity, rr.Image(np.ascontiguousarray(image[::-1])), static=static)


def _log_both(
    stream: Any,
    recording: Recording,
    entities: tuple[str, str],
    kinds: tuple[Any, Any],
    shapes: Sequence[np.ndarray],
    radii: tuple[float, float],
    lift_m: float = _LIFT_M,
    static: bool = False,
    **looks: Any,
) -> None:
    """Logs points or lines over the ground and on the maps.

    Args:
        stream: a recording stream of Rerun's.
        recording: whose ground it is.
        entities: over the ground, and on the maps.
        kinds: `_POINTS` or `_STRIPS`.
        shapes: points, (x, y) of shape [2] each, or lines of shape [N, 2].
        radii: in metres, and in cells.
        lift_m: height over the ground.
        static: for all times.
        **looks: as both archetypes take them.
    """
    lifted = [_over_ground(recording, shape, lift_m) for shape in shapes]
    flat = [_on_map(recording, shape) for shape in shapes]
    for entity, kind, drawn, radius in zip(entities, kinds, (lifted, flat), radii, strict=True):
        stream.log(entity, kind(drawn, radii=radius, **looks), static=static)


def _over_ground(recording: Recording, place: np.ndarray, lift_m: float = _LIFT_M) -> np.ndarray:
    """Puts positions (x, y) of shape [..., 2] over the ground; x and y stay as they are."""
    height = recording.elevation_m[_cells_of(recording, place)] + lift_m
    return np.concatenate((place, height[..., None]), axis=-1).astype(np.float32)


def _on_map(recording: Recording, place: np.ndarray) -> np.ndarray:
    """Puts positions (x, y) of shape [..., 2] on the images."""
    x, y = np.moveaxis(place, -1, 0) / recording.resolution_m
    return np.stack((x, recording.grid.height - y), axis=-1)


def _cells_of(recording: Recording, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the cells that positions of shape [..., 2] lie in, or of the nearest ones."""
    column, row = np.moveaxis(np.floor(place / recording.resolution_m).astype(int), -1, 0)
    return row.clip(0, recording.grid.height - 1), column.clip(0, recording.grid.width - 1)


def _log_robot(stream: Any, driver: Driver) -> None:
    """Logs where the robot is and where it heads, at every step."""
    recording = driver.recording
    heading_rad, colours = recording.states[:, 2], [driver.colour]
    times = rr.TimeColumn(TIMELINE, duration=np.arange(len(heading_rad)) * recording.dt_s)
    lifted, flat = _over_ground(recording, recording.track), _on_map(recording, recording.track)
    ahead = _HEADING_M * np.stack((np.cos(heading_rad), np.sin(heading_rad), 0 * heading_rad), axis=1)
    ahead_flat = ahead[:, :2] * (1, -1) / recording.resolution_m
    for root, dots, arrows, places, vectors, radius in (
        ("world", rr.Points3D, rr.Arrows3D, lifted, ahead, 0.3),
        ("map/overlay", rr.Points2D, rr.Arrows2D, flat, ahead_flat, 0.7),
    ):
        robot, heading = driver.entity(root, "robot"), driver.entity(root, "heading")
        stream.send_columns(robot, [times], dots.columns(positions=places))
        stream.send_columns(heading, [times], arrows.columns(origins=places, vectors=vectors))
        stream.log(robot, dots.from_fields(radii=[radius], colors=colours), static=True)
        stream.log(heading, arrows.from_fields(radii=[radius / 3], colors=colours), static=True)


def _log_series(stream: Any, driver: Driver) -> None:
    """Logs observed λ and predicted, the threshold of free ground, the distance to the goal, and commands."""
    recording = driver.recording
    place = recording.track[:-1]
    times = rr.TimeColumn(TIMELINE, duration=np.arange(len(place)) * recording.dt_s)
    lines = {
        driver.entity("series/traversability", "observed"): recording.traversability,
        driver.entity("series/goal", "distance"): np.linalg.norm(place - recording.goal_m, axis=1),
    }
    if not driver.name:
        cells = zip(*_cells_of(recording, place), strict=True)
        predicted = [recording.given_at(step)[0][cell] for step, cell in enumerate(cells)]
        lines["series/traversability/predicted"] = np.array(predicted)
        lines["series/traversability/threshold"] = np.full(len(place), recording.free_above)
        for name, commanded in zip(recording.action_names, recording.actions.T, strict=True):
            lines[f"series/command/{rr.escape_entity_path_part(name)}"] = commanded
        named = f"free: {'mean' if recording.free_by == 'mean' else 'λ̂'} above"
        style = rr.SeriesLines(colors=[(200, 60, 60)], names=[named])
        stream.log("series/traversability/threshold", style, static=True)
    for entity, values in lines.items():
        stream.send_columns(entity, [times], rr.Scalars.columns(scalars=values.astype(np.float64)))
        if driver.name:
            style = rr.SeriesLines(colors=[driver.colour], names=[driver.name])
            stream.log(entity, style, static=True)


def _log_driven(stream: Any, driver: Driver) -> None:
    """Logs the path driven so far, coloured by the observed λ, or in the robot's colour where it is not alone."""
    recording = driver.recording
    place = recording.track
    count, every = len(recording.traversability), drawing_interval(recording.dt_s)
    colours = shades(recording.traversability)
    for piece, first in enumerate(range(0, count, _PIECE * every)):
        last = min(first + _PIECE * every, count)
        for step in [*range(first + every, last, every), last]:
            stream.set_time(TIMELINE, duration=step * recording.dt_s)
            lines = [place[first : step + 1]]
            if not driver.name:
                lines = [place[k : k + 2] for k in range(first, step)]
            shown = [driver.colour] if driver.name else colours[first:step]
            entities = driver.entities(f"driven/{piece:03}")
            _log_both(stream, recording, entities, _STRIPS, lines, (0.08, 0.25), colors=shown)


def _log_plans(stream: Any, driver: Driver) -> None:
    """Logs what was planned, when it was planned; of a robot that is not alone, the path alone."""
    known: dict[str, list[bytes]] = {}
    for plan in map(thinned, driver.recording.own_plans):
        stream.set_time(TIMELINE, duration=plan.step * driver.recording.dt_s)
        for name, style in STYLES.items():
            lines = list(plan.lines.get(name, ()))
            content = [line.tobytes() for line in lines]
            # A layer without lines is logged too: it wipes out the earlier plan's. One that stays is not.
            if (driver.name and name != "path") or known.get(name) == content:
                continue
            known[name] = content
            colours = [(*driver.colour[:3], _TRANSLUCENT) if driver.name else bytes_of(style.colour)]
            radii = (_RADIUS_M * style.width, _RADIUS_CELLS * style.width)
            entities = driver.entities(f"plan/{name}")
            _log_both(stream, driver.recording, entities, _STRIPS, lines, radii, colors=colours)


def _log_outcome(stream: Any, driver: Driver) -> None:
    """Says how the episode ended where it ended, from that moment on, and marks a robot that was held."""
    recording = driver.recording
    words = [f"{driver.name}: {recording.outcome}" if driver.name else recording.outcome]
    stream.set_time(TIMELINE, duration=recording.end_s)
    _log_both(
        stream, recording, driver.entities("outcome"), _POINTS, [recording.track[-1]],
        (0.05, 0.1), _LIFT_M + 0.6, labels=words, show_labels=True, colors=[driver.colour],
    )  # fmt: skip
    if recording.immobilised_at is not None:
        cross = (recording.immobilised_at + _CROSS_M * _CROSS).astype(np.float32)
        _log_both(
            stream, recording, driver.entities("immobilised"), _STRIPS, [cross], (0.12, 0.3), _LIFT_M + 0.3,
            colors=[_MARK],
        )  # fmt: skip
