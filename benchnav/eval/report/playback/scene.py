"""Contents of the Rerun viewer: terrain, maps, and each robot's state and plans.

For robots that learn, the viewer also shows the belief over time and the sensors'
footprint. The terrain is a mesh with the path `world`, in metres. Maps are images with
the path `map`, in cells, with the first row at the bottom.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from benchnav.core.grid import outline
from benchnav.eval.figures.moment import known_colours, true_colours
from benchnav.eval.recorded_plans import thinned
from benchnav.eval.recording import Recording, drawing_interval
from benchnav.viz.drives import MARKS
from benchnav.viz.maps import FOOTPRINT, SOFT, hatching, layer_colours, shades
from benchnav.viz.plans import STYLES
from benchnav.viz.style import bytes_of

TIMELINE = "time"

# Radii of lines of plans, for a width of 1 point.
_RADIUS_M = 0.02
_RADIUS_CELLS = 0.06
_HEADING_M = 1.2  # length of the arrow of the heading
# The driven path is logged in segments of this number of drawing intervals. At each
# interval, the current segment is logged again from its start.
_SEGMENT = 10
# A cross (X) in one stroke, and half of its width.
_CROSS = np.array([(-1, -1), (1, 1), (0, 0), (-1, 1), (1, -1)], dtype=np.float32)
_CROSS_M = 1.0
_MARK = (255, 255, 255)  # colour of the cross
_TRANSLUCENT = 160  # opacity of a plan, in [0, 255]
_LIFT_M = 0.12  # height of lines over the terrain
_CLOSED = (240, 240, 240)  # colour of the edge of non-free cells

# Archetypes for the terrain and for the maps.
_POINTS = (rr.Points3D, rr.Points2D)
_STRIPS = (rr.LineStrips3D, rr.LineStrips2D)


@dataclass(frozen=True, kw_only=True)
class Driver:
    """A robot of a recording.

    Args:
        recording: episode of the robot.
        name: unique name; empty if there is only one robot.
        colour: RGB colour, optionally with opacity, in [0, 255].
    """

    recording: Recording
    name: str
    colour: tuple[int, ...]

    def entity(self, root: str, *leaf: str) -> str:
        """Return the path of an entity of the robot.

        Args:
            root: start of the path, such as `world`.
            *leaf: end of the path.
        """
        branch = []
        if self.name:
            branch = ["conditions", rr.escape_entity_path_part(self.name)]
        return "/".join([root, *branch, *leaf])

    def entities(self, leaf: str) -> tuple[str, str]:
        """Return two paths of an entity: for the terrain, and for the maps."""
        return self.entity("world", leaf), self.entity("map/overlay", leaf)


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Terrain and maps of one recording, on which points, lines and images are logged.

    Args:
        stream: recording stream of Rerun.
        recording: recording of the terrain.
    """

    stream: Any
    recording: Recording

    def at(self, step: int) -> None:
        """Set the time of the following entries to a step."""
        self.stream.set_time(TIMELINE, duration=step * self.recording.dt_s)

    def image(self, entity: str, image: np.ndarray, static: bool = True) -> None:
        """Log a map as an image, whose first row is at the top.

        Args:
            entity: path of the image.
            image: map, uint8, shape [H, W, 3]; its first row is at the bottom.
            static: whether the image is valid for all times.
        """
        flipped = np.ascontiguousarray(image[::-1])
        self.stream.log(entity, rr.Image(flipped), static=static)

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

    def on_both(
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
            entities: paths for the terrain and for the maps.
            kinds: `_POINTS` or `_STRIPS`.
            shapes: points (x, y) in metres, each of shape [2]; or lines, each of shape
                [N, 2].
            radii: radius in metres for the terrain, and in cells for the maps.
            lift_m: height over the terrain in metres.
            **looks: options of both archetypes; with `static`, the shapes are valid for
                all times.
        """
        static = looks.pop("static", False)
        lifted = [self.lifted(shape, lift_m) for shape in shapes]
        flat = [self.flat(shape) for shape in shapes]
        for index, positions in enumerate((lifted, flat)):
            drawn = kinds[index](positions, radii=radii[index], **looks)
            self.stream.log(entities[index], drawn, static=static)

    def lifted(self, positions: np.ndarray, lift_m: float = _LIFT_M) -> np.ndarray:
        """Return points (x, y, z) over the terrain at positions of shape [..., 2]."""
        height = self.recording.elevation_m[self.cells(positions)] + lift_m
        points = np.concatenate((positions, height[..., None]), axis=-1)
        return points.astype(np.float32)

    def flat(self, positions: np.ndarray) -> np.ndarray:
        """Return image coordinates of positions (x, y) in metres, shape [..., 2]."""
        cells = positions / self.recording.resolution_m
        return cells * (1, -1) + (0, self.recording.grid.height)

    def cells(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns of the cells nearest to positions of shape [..., 2]."""
        shape = np.array(self.recording.grid.shape)
        indices = np.floor(positions / self.recording.resolution_m).astype(int)
        on_grid = indices[..., ::-1].clip(0, shape - 1)
        row, column = np.moveaxis(on_grid, -1, 0)
        return row, column


def log_terrain(stage: Stage) -> None:
    """Log the terrain as a mesh, and the maps that all robots share."""
    recording = stage.recording
    stage.stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stage.stream.log("world/terrain", _mesh(recording), static=True)
    stage.image("map/colour", np.moveaxis(recording.rgb, 0, -1))
    stage.image("map/true_mean", shades(recording.true_mean))
    for name, layer in recording.layers.items():
        stage.image(layer_entity(name), layer_colours(name, layer))
    if recording.field is not None:
        stage.image("map/field", true_colours(recording))
    if recording.soft.any():
        for name, lines_of in (("outline", outline), ("hatching", hatching)):
            lines = lines_of(recording.soft, recording.resolution_m)
            stage.edges(f"map/soft/{name}", lines, bytes_of(SOFT), 0.06)
    radii = (0.35, 0.7)
    for name, position in (("start", recording.track[0]), ("goal", recording.goal_m)):
        entities = (f"world/{name}", f"map/places/{name}")
        colours = [bytes_of(MARKS[name]["color"])]
        stage.on_both(entities, _POINTS, [position], radii, static=True, colors=colours)


def _mesh(recording: Recording) -> Any:
    """Return the mesh of the terrain, with one vertex per cell.

    Four neighbouring vertices form a square of two triangles.
    """
    grid = recording.grid
    rows, columns = np.mgrid[: grid.height, : grid.width]
    x_m = (columns + 0.5) * grid.resolution_m
    y_m = (rows + 0.5) * grid.resolution_m
    vertices = np.stack((x_m, y_m, recording.elevation_m), axis=-1)
    numbers = rows * grid.width + columns
    corner = numbers[:-1, :-1].ravel()
    right = corner + 1
    above = corner + grid.width
    squares = np.stack((corner, right, above, right, above + 1, above), axis=1)
    return rr.Mesh3D(
        vertex_positions=vertices.reshape(-1, 3),
        triangle_indices=squares.reshape(-1, 3),
        vertex_colors=recording.rgb.reshape(3, -1).T,
    )


def layer_entity(name: str) -> str:
    """Return the path of the image of a layer."""
    return f"map/layers/{rr.escape_entity_path_part(name)}"


def log_driver(stream: Any, driver: Driver) -> None:
    """Log all entities of a robot."""
    stage = Stage(stream=stream, recording=driver.recording)
    _log_known(stage, driver)
    _log_robot(stage, driver)
    _log_series(stage, driver)
    _log_driven(stage, driver)
    _log_plans(stage, driver)
    _log_outcome(stage, driver)


def _log_known(stage: Stage, driver: Driver) -> None:
    """Log a planner's λ̂, the edge of non-free cells, and the robot's belief."""
    recording = driver.recording
    learns = bool(recording.known)
    steps = [known_map.step for known_map in recording.known]
    for step in steps or [0]:
        if learns:
            stage.at(step)
        for name, colours in known_colours(recording, step).items():
            stage.image(driver.entity(f"map/{name}"), colours, not learns)
        _, free = recording.given_at(step)
        edge = outline(~free, recording.resolution_m)
        stage.edges(driver.entity("map/closed"), edge, _CLOSED, 0.08, not learns)
    entities = driver.entities("reach")
    line_colours = [driver.colour if driver.name else bytes_of(FOOTPRINT)]
    for known_map in recording.known:
        stage.at(known_map.step)
        lines = known_map.outlines
        stage.on_both(entities, _STRIPS, lines, (0.05, 0.15), colors=line_colours)


def _log_robot(stage: Stage, driver: Driver) -> None:
    """Log the robot's position and heading at each step."""
    recording = driver.recording
    heading_rad = recording.states[:, 2]
    times = times_of(recording, len(heading_rad))
    components = (np.cos(heading_rad), np.sin(heading_rad), 0 * heading_rad)
    ahead = _HEADING_M * np.stack(components, axis=1)
    ahead_flat = ahead[:, :2] * (1, -1) / recording.resolution_m
    lifted = stage.lifted(recording.track)
    flat = stage.flat(recording.track)
    # A dot would hide the wheels of a robot with a footprint.
    dot_size = 1.0 if recording.contacts_m is None else 0.2
    for root, dots, arrows, positions, vectors, radius in (
        ("world", rr.Points3D, rr.Arrows3D, lifted, ahead, 0.3),
        ("map/overlay", rr.Points2D, rr.Arrows2D, flat, ahead_flat, 0.7),
    ):
        robot = driver.entity(root, "robot")
        moving = dots.columns(positions=positions)
        dot = dots.from_fields(radii=[dot_size * radius], colors=[driver.colour])
        stage.stream.send_columns(robot, [times], moving)
        stage.stream.log(robot, dot, static=True)
        heading = driver.entity(root, "heading")
        turning = arrows.columns(origins=positions, vectors=vectors)
        arrow = arrows.from_fields(
            radii=[dot_size * radius / 3], colors=[driver.colour]
        )
        stage.stream.send_columns(heading, [times], turning)
        stage.stream.log(heading, arrow, static=True)


def times_of(recording: Recording, count: int) -> Any:
    """Return the column of the times of the first `count` steps of an episode."""
    return rr.TimeColumn(TIMELINE, duration=np.arange(count) * recording.dt_s)


def _log_series(stage: Stage, driver: Driver) -> None:
    """Log time series: observed λ and the distance to the goal.

    For a single robot, also log λ̂, the threshold of free cells, and the commands.
    """
    recording = driver.recording
    positions = recording.track[:-1]
    n_steps = len(positions)
    times = times_of(recording, n_steps)
    distance_m = np.linalg.norm(positions - recording.goal_m, axis=1)
    lines = {
        driver.entity("series/traversability", "observed"): recording.traversability,
        driver.entity("series/goal", "distance"): distance_m,
    }
    if not driver.name:
        predicted = np.empty(n_steps)
        for step, cell in enumerate(zip(*stage.cells(positions), strict=True)):
            risk_map, _ = recording.given_at(step)
            predicted[step] = risk_map[cell]
        threshold = "series/traversability/threshold"
        lines["series/traversability/predicted"] = predicted
        lines[threshold] = np.full(n_steps, recording.free_above)
        commands = zip(recording.action_names, recording.actions.T, strict=True)
        for name, commanded in commands:
            lines[f"series/command/{rr.escape_entity_path_part(name)}"] = commanded
        by = "mean" if recording.free_by == "mean" else "λ̂"
        style = rr.SeriesLines(colors=[(200, 60, 60)], names=[f"free: {by} above"])
        stage.stream.log(threshold, style, static=True)
    for entity, values in lines.items():
        scalars = rr.Scalars.columns(scalars=values.astype(np.float64))
        stage.stream.send_columns(entity, [times], scalars)
        if driver.name:
            style = rr.SeriesLines(colors=[driver.colour], names=[driver.name])
            stage.stream.log(entity, style, static=True)


def _log_driven(stage: Stage, driver: Driver) -> None:
    """Log the driven path over time, in colours of observed λ for a single robot."""
    recording = driver.recording
    positions = recording.track
    count = len(recording.traversability)
    interval = drawing_interval(recording.dt_s)
    colours = shades(recording.traversability)
    length = _SEGMENT * interval
    for segment, first in enumerate(range(0, count, length)):
        entities = driver.entities(f"driven/{segment:03}")
        last = min(first + length, count)
        for step in [*range(first + interval, last, interval), last]:
            stage.at(step)
            lines = [positions[first : step + 1]]
            line_colours: Any = [driver.colour]
            if not driver.name:
                lines = [positions[k : k + 2] for k in range(first, step)]
                line_colours = colours[first:step]
            stage.on_both(entities, _STRIPS, lines, (0.08, 0.25), colors=line_colours)


def _log_plans(stage: Stage, driver: Driver) -> None:
    """Log the plans at their steps; if there are several robots, only planned paths."""
    logged: dict[str, list[bytes]] = {}
    for plan in map(thinned, driver.recording.own_plans):
        stage.at(plan.step)
        for name, style in STYLES.items():
            lines = list(plan.lines.get(name, ()))
            content = [line.tobytes() for line in lines]
            # An empty layer is logged, since it replaces the layer of the earlier plan.
            # Unchanged layers are skipped.
            if (driver.name and name != "path") or logged.get(name) == content:
                continue
            logged[name] = content
            colour = bytes_of(style.colour)
            if driver.name:
                colour = (*driver.colour[:3], _TRANSLUCENT)
            radii = (_RADIUS_M * style.width, _RADIUS_CELLS * style.width)
            entities = driver.entities(f"plan/{name}")
            stage.on_both(entities, _STRIPS, lines, radii, colors=[colour])


def _log_outcome(stage: Stage, driver: Driver) -> None:
    """Log the outcome at the last position, and a mark if the robot was immobilised."""
    recording = driver.recording
    words = recording.outcome
    if driver.name:
        words = f"{driver.name}: {words}"
    stage.at(len(recording.traversability))
    looks = {"labels": [words], "show_labels": True, "colors": [driver.colour]}
    entities = driver.entities("outcome")
    end = [recording.track[-1]]
    stage.on_both(entities, _POINTS, end, (0.05, 0.1), _LIFT_M + 0.6, **looks)
    if recording.immobilised_at is not None:
        cross = (recording.immobilised_at + _CROSS_M * _CROSS).astype(np.float32)
        entities = driver.entities("immobilised")
        stage.on_both(
            entities, _STRIPS, [cross], (0.12, 0.3), _LIFT_M + 0.3, colors=[_MARK]
        )
