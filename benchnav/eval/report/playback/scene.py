"""What all robots of a recording share in the Rerun viewer: terrain, maps, start and goal.

The terrain is a mesh under `world`, in metres; maps are images under `map`, in cells, their first row at the
bottom.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr

from benchnav.core.figures import MARKS, bytes_of, hatching, outline
from benchnav.core.grid import Grid
from benchnav.eval.recording import Recording
from benchnav.eval.report.plan_layers import SOFT, field_colours, shades

LIFT_M = 0.12
_CLOSED = (240, 240, 240)

# Archetypes over the ground and on the maps.
POINTS, STRIPS = (rr.Points3D, rr.Points2D), (rr.LineStrips3D, rr.LineStrips2D)


def log_terrain(stream: Any, recording: Recording) -> None:
    """Logs the ground as a mesh, once for all times."""
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


def log_maps(stream: Any, recording: Recording) -> None:
    """Logs the maps that are no planner's own: colour, soft ground, λ in truth."""
    grid = recording.grid
    log_image(stream, "map/colour", np.moveaxis(recording.rgb, 0, -1))
    log_image(stream, "map/true_mean", shades(recording.true_mean))
    if recording.field is not None:
        log_image(stream, "map/field", field_colours(recording.field, recording.immobilising))
    if recording.soft.any():
        for name, lines in (("outline", outline), ("hatching", hatching)):
            flat = on_map(grid, lines(recording.soft, grid.resolution_m))
            stream.log(
                f"map/soft/{name}", rr.LineStrips2D(flat, colors=[bytes_of(SOFT)], radii=0.06), static=True
            )
    for name, place in (("start", recording.track[0]), ("goal", recording.goal_m)):
        entities, colour = (f"world/{name}", f"map/places/{name}"), bytes_of(MARKS[name]["color"])
        log_both(stream, recording, entities, POINTS, [place], (0.35, 0.7), static=True, colors=[colour])


def log_predicted(stream: Any, recording: Recording, risk: str, closed: str) -> None:
    """Logs the λ̂ that a planner was given, and the edge of ground that is not free.

    Args:
        stream: a recording stream of Rerun's.
        recording: the planner's.
        risk: entity of the map.
        closed: entity of the edge.
    """
    image = shades(recording.predicted)
    image[~recording.free] = 64
    log_image(stream, risk, image)
    flat = on_map(recording.grid, outline(~recording.free, recording.resolution_m))
    stream.log(closed, rr.LineStrips2D(flat, colors=[_CLOSED], radii=0.08), static=True)


def log_image(stream: Any, entity: str, image: np.ndarray) -> None:
    """Logs a map, uint8 of shape [H, W, 3], as an image; images have their first row at the top."""
    stream.log(entity, rr.Image(np.ascontiguousarray(image[::-1])), static=True)


def log_both(
    stream: Any,
    recording: Recording,
    entities: tuple[str, str],
    kinds: tuple[Any, Any],
    shapes: Sequence[np.ndarray],
    radii: tuple[float, float],
    lift_m: float = LIFT_M,
    static: bool = False,
    **looks: Any,
) -> None:
    """Logs points or lines over the ground and on the maps.

    Args:
        stream: a recording stream of Rerun's.
        recording: whose ground it is.
        entities: over the ground, and on the maps.
        kinds: `POINTS` or `STRIPS`.
        shapes: points, (x, y) of shape [2] each, or lines of shape [N, 2].
        radii: in metres, and in cells.
        lift_m: height over the ground.
        static: for all times.
        **looks: as both archetypes take them.
    """
    lifted = [over_ground(recording, shape, lift_m) for shape in shapes]
    flat = [on_map(recording.grid, shape) for shape in shapes]
    for entity, kind, drawn, radius in zip(entities, kinds, (lifted, flat), radii, strict=True):
        stream.log(entity, kind(drawn, radii=radius, **looks), static=static)


def over_ground(recording: Recording, place: np.ndarray, lift_m: float = LIFT_M) -> np.ndarray:
    """Puts positions (x, y) of shape [..., 2] over the ground; x and y stay as they are."""
    height = recording.elevation_m[cells_of(recording.grid, place)] + lift_m
    return np.concatenate((place, height[..., None]), axis=-1).astype(np.float32)


def on_map(grid: Grid, place: np.ndarray) -> np.ndarray:
    """Puts positions (x, y) of shape [..., 2] on the images."""
    x, y = np.moveaxis(place, -1, 0) / grid.resolution_m
    return np.stack((x, grid.height - y), axis=-1)


def cells_of(grid: Grid, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the cells that positions of shape [..., 2] lie in, or of the nearest ones."""
    column, row = np.moveaxis(np.floor(place / grid.resolution_m).astype(int), -1, 0)
    return row.clip(0, grid.height - 1), column.clip(0, grid.width - 1)
