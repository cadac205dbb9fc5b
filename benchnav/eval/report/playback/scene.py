"""What the Rerun viewer shows: terrain, maps, start and goal; and of each robot where
it is, what it planned and met.

Of robots that learn on their way it shows what they knew when, and how far their
sensors reached.

The terrain is a mesh under `world`, in metres; maps are images under `map`, in cells,
their first row at the bottom.
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
    hatching,
    layer_colours,
    shades,
)
from benchnav.viz.plans import STYLES
from benchnav.viz.style import bytes_of

TIMELINE = "time"

_RADIUS_M, _RADIUS_CELLS = 0.02, 0.06
_HEADING_M = 1.2
# Plans drawn until a new piece of the driven path is begun: at each plan all of a piece
# is logged.
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
        name: different from those of the others; empty if there is only one robot.
        colour: red, green, blue and opacity, in [0, 255].
    """

    recording: Recording
    name: str
    colour: tuple[int, ...]

    def entity(self, root: str, *leaf: str) -> str:
        """Return the path of what is the robot's own under a root."""
        own = ["conditions", rr.escape_entity_path_part(self.name)] if self.name else []
        return "/".join([root, *own, *leaf])

    def entities(self, leaf: str) -> tuple[str, str]:
        """Return the paths of what is its own over the terrain and on the maps."""
        return self.entity("world", leaf), self.entity("map/overlay", leaf)


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Terrain and maps of one recording, which points, lines and images are logged on.

    Args:
        stream: a recording stream of Rerun's.
        recording: whose terrain it is.
    """

    stream: Any
    recording: Recording

    def at(self, step: int) -> None:
        """Log what follows from a step on."""
        self.stream.set_time(TIMELINE, duration=step * self.recording.dt_s)

    def image(self, entity: str, image: np.ndarray, static: bool = True) -> None:
        """Log a map, uint8 of shape [H, W, 3], as an image; images have their first row
        at the top.
        """
        self.stream.log(
            entity, rr.Image(np.ascontiguousarray(image[::-1])), static=static
        )

    def edges(
        self,
        entity: str,
        lines: np.ndarray,
        colour: Any,
        radius: float,
        static: bool = True,
    ) -> None:
        """Log lines on the maps only."""
        strips = rr.LineStrips2D(self.flat(lines), colors=[colour], radii=radius)
        self.stream.log(entity, strips, static=static)

    def both(
        self,
        entities: tuple[str, str],
        kinds: tuple[Any, Any],
        shapes: Sequence[np.ndarray],
        radii: tuple[float, float],
        lift_m: float = _LIFT_M,
        **looks: Any,
    ) -> None:
        """Log points or lines over the terrain and on the maps.

        Args:
            entities: over the terrain, and on the maps.
            kinds: `_POINTS` or `_STRIPS`.
            shapes: points, (x, y) of shape [2] each, or lines of shape [N, 2].
            radii: in metres, and in cells.
            lift_m: height over the terrain.
            **looks: as both archetypes take them; and `static`, for all times.
        """
        static = looks.pop("static", False)
        places = (
            [self.lifted(shape, lift_m) for shape in shapes],
            [self.flat(shape) for shape in shapes],
        )
        for entity, kind, drawn, radius in zip(
            entities, kinds, places, radii, strict=True
        ):
            self.stream.log(entity, kind(drawn, radii=radius, **looks), static=static)

    def lifted(self, positions: np.ndarray, lift_m: float = _LIFT_M) -> np.ndarray:
        """Put positions (x, y) of shape [..., 2] over the terrain; x and y stay as they
        are.
        """
        height = self.recording.elevation_m[self.cells(positions)] + lift_m
        return np.concatenate((positions, height[..., None]), axis=-1).astype(
            np.float32
        )

    def flat(self, positions: np.ndarray) -> np.ndarray:
        """Put positions (x, y) of shape [..., 2] on the images."""
        return positions / self.recording.resolution_m * (1, -1) + (
            0,
            self.recording.grid.height,
        )

    def cells(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns of the cells that positions of shape [..., 2] lie in,
        or of the nearest.
        """
        shape = np.array(self.recording.grid.shape)
        indices = np.floor(positions / self.recording.resolution_m).astype(int)[
            ..., ::-1
        ]
        row, column = np.moveaxis(indices.clip(0, shape - 1), -1, 0)
        return row, column


def log_terrain(stage: Stage) -> None:
    """Log the terrain as a mesh, and the maps that are no planner's own: colour,
    layers, soft terrain, λ in truth.
    """
    recording, stream, grid = stage.recording, stage.stream, stage.recording.grid
    rows, columns = np.mgrid[: grid.height, : grid.width]
    x_m, y_m = ((cells + 0.5) * grid.resolution_m for cells in (columns, rows))
    corner = (rows * grid.width + columns)[:-1, :-1].ravel()
    right, above = corner + 1, corner + grid.width
    triangles = np.stack(
        (corner, right, above, right, above + 1, above), axis=1
    ).reshape(-1, 3)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    mesh = rr.Mesh3D(
        vertex_positions=np.stack((x_m, y_m, recording.elevation_m), axis=-1).reshape(
            -1, 3
        ),
        triangle_indices=triangles,
        vertex_colors=recording.rgb.reshape(3, -1).T,
    )
    stream.log("world/terrain", mesh, static=True)
    images = {
        "map/colour": np.moveaxis(recording.rgb, 0, -1),
        "map/true_mean": shades(recording.true_mean),
        **{
            layer_entity(name): layer_colours(name, layer)
            for name, layer in recording.layers.items()
        },
        **({} if recording.field is None else {"map/field": true_colours(recording)}),
    }
    for entity, image in images.items():
        stage.image(entity, image)
    if recording.soft.any():
        for name, lines in (("outline", outline), ("hatching", hatching)):
            stage.edges(
                f"map/soft/{name}",
                lines(recording.soft, grid.resolution_m),
                bytes_of(SOFT),
                0.06,
            )
    for name, position in (("start", recording.track[0]), ("goal", recording.goal_m)):
        entities, colours = (
            (f"world/{name}", f"map/places/{name}"),
            [bytes_of(MARKS[name]["color"])],
        )
        stage.both(
            entities, _POINTS, [position], (0.35, 0.7), static=True, colors=colours
        )


def layer_entity(name: str) -> str:
    """Return the path of the image of a layer."""
    return f"map/layers/{rr.escape_entity_path_part(name)}"


def log_driver(stream: Any, driver: Driver) -> None:
    """Log all that is a robot's own."""
    stage = Stage(stream=stream, recording=driver.recording)
    for log in (
        _log_known,
        _log_robot,
        _log_series,
        _log_driven,
        _log_plans,
        _log_outcome,
    ):
        log(stage, driver)


def _log_known(stage: Stage, driver: Driver) -> None:
    """Log the λ̂ that a planner had with the edge of non-free terrain, and what a robot
    learnt during the episode.
    """
    recording = driver.recording
    learns = bool(recording.known)
    for step in [known.step for known in recording.known] or [0]:
        if learns:
            stage.at(step)
        for name, colours in known_colours(recording, step).items():
            stage.image(driver.entity(f"map/{name}"), colours, not learns)
        _, free = recording.given_at(step)
        edge = outline(~free, recording.resolution_m)
        stage.edges(driver.entity("map/closed"), edge, _CLOSED, 0.08, not learns)
    for known in recording.known:
        stage.at(known.step)
        reach = [driver.colour if driver.name else bytes_of(REACH)]
        stage.both(
            driver.entities("reach"),
            _STRIPS,
            known.outlines,
            (0.05, 0.15),
            colors=reach,
        )


def _log_robot(stage: Stage, driver: Driver) -> None:
    """Logs where the robot is and where it heads, at every step."""
    recording = driver.recording
    heading_rad, colours = recording.states[:, 2], [driver.colour]
    times = rr.TimeColumn(
        TIMELINE, duration=np.arange(len(heading_rad)) * recording.dt_s
    )
    lifted, flat = stage.lifted(recording.track), stage.flat(recording.track)
    ahead = _HEADING_M * np.stack(
        (np.cos(heading_rad), np.sin(heading_rad), 0 * heading_rad), axis=1
    )
    ahead_flat = ahead[:, :2] * (1, -1) / recording.resolution_m
    for root, dots, arrows, places, vectors, radius in (
        ("world", rr.Points3D, rr.Arrows3D, lifted, ahead, 0.3),
        ("map/overlay", rr.Points2D, rr.Arrows2D, flat, ahead_flat, 0.7),
    ):
        robot, heading = driver.entity(root, "robot"), driver.entity(root, "heading")
        stage.stream.send_columns(robot, [times], dots.columns(positions=places))
        stage.stream.send_columns(
            heading, [times], arrows.columns(origins=places, vectors=vectors)
        )
        stage.stream.log(
            robot, dots.from_fields(radii=[radius], colors=colours), static=True
        )
        stage.stream.log(
            heading, arrows.from_fields(radii=[radius / 3], colors=colours), static=True
        )


def _log_series(stage: Stage, driver: Driver) -> None:
    """Logs observed λ and predicted, the threshold of free ground, the distance to the
    goal, and commands.
    """
    recording = driver.recording
    place = recording.track[:-1]
    times = rr.TimeColumn(TIMELINE, duration=np.arange(len(place)) * recording.dt_s)
    lines = {
        driver.entity("series/traversability", "observed"): recording.traversability,
        driver.entity("series/goal", "distance"): np.linalg.norm(
            place - recording.goal_m, axis=1
        ),
    }
    if not driver.name:
        cells = zip(*stage.cells(place), strict=True)
        predicted = [
            recording.given_at(step)[0][cell] for step, cell in enumerate(cells)
        ]
        lines["series/traversability/predicted"] = np.array(predicted)
        lines["series/traversability/threshold"] = np.full(
            len(place), recording.free_above
        )
        for name, commanded in zip(
            recording.action_names, recording.actions.T, strict=True
        ):
            lines[f"series/command/{rr.escape_entity_path_part(name)}"] = commanded
        named = f"free: {'mean' if recording.free_by == 'mean' else 'λ̂'} above"
        style = rr.SeriesLines(colors=[(200, 60, 60)], names=[named])
        stage.stream.log("series/traversability/threshold", style, static=True)
    for entity, values in lines.items():
        stage.stream.send_columns(
            entity, [times], rr.Scalars.columns(scalars=values.astype(np.float64))
        )
        if driver.name:
            style = rr.SeriesLines(colors=[driver.colour], names=[driver.name])
            stage.stream.log(entity, style, static=True)


def _log_driven(stage: Stage, driver: Driver) -> None:
    """Logs the path driven so far, coloured by the observed λ, or in the robot's colour
    where it is not alone.
    """
    recording = driver.recording
    place = recording.track
    count, every = len(recording.traversability), drawing_interval(recording.dt_s)
    colours = shades(recording.traversability)
    for piece, first in enumerate(range(0, count, _PIECE * every)):
        last = min(first + _PIECE * every, count)
        for step in [*range(first + every, last, every), last]:
            stage.at(step)
            lines = [place[first : step + 1]]
            if not driver.name:
                lines = [place[k : k + 2] for k in range(first, step)]
            shown = [driver.colour] if driver.name else colours[first:step]
            entities = driver.entities(f"driven/{piece:03}")
            stage.both(entities, _STRIPS, lines, (0.08, 0.25), colors=shown)


def _log_plans(stage: Stage, driver: Driver) -> None:
    """Logs what was planned, when it was planned; of a robot that is not alone, the
    path alone.
    """
    known: dict[str, list[bytes]] = {}
    for plan in map(thinned, driver.recording.own_plans):
        stage.at(plan.step)
        for name, style in STYLES.items():
            lines = list(plan.lines.get(name, ()))
            content = [line.tobytes() for line in lines]
            # A layer without lines is logged too: it wipes out the earlier plan's. One
            # that stays is not.
            if (driver.name and name != "path") or known.get(name) == content:
                continue
            known[name] = content
            colours = [
                (*driver.colour[:3], _TRANSLUCENT)
                if driver.name
                else bytes_of(style.colour)
            ]
            radii = (_RADIUS_M * style.width, _RADIUS_CELLS * style.width)
            entities = driver.entities(f"plan/{name}")
            stage.both(entities, _STRIPS, lines, radii, colors=colours)


def _log_outcome(stage: Stage, driver: Driver) -> None:
    """Says how the episode ended where it ended, from that moment on, and marks a robot
    that was held.
    """
    recording = driver.recording
    words = [
        f"{driver.name}: {recording.outcome}" if driver.name else recording.outcome
    ]
    stage.at(len(recording.traversability))
    looks = {"labels": words, "show_labels": True, "colors": [driver.colour]}
    end = [recording.track[-1]]
    stage.both(
        driver.entities("outcome"), _POINTS, end, (0.05, 0.1), _LIFT_M + 0.6, **looks
    )
    if recording.immobilised_at is not None:
        cross = (recording.immobilised_at + _CROSS_M * _CROSS).astype(np.float32)
        entities = driver.entities("immobilised")
        stage.both(
            entities, _STRIPS, [cross], (0.12, 0.3), _LIFT_M + 0.3, colors=[_MARK]
        )
