"""What all robots of a recording share in the Rerun viewer: terrain, maps, start and goal.

The terrain is a mesh under `world`, in metres; maps are images under `map`, in cells, their first row at the
bottom.
"""

from typing import Any

import numpy as np

from benchnav.core.figures import MARKS, bytes_of
from benchnav.core.grid import Grid
from benchnav.eval.recording import Recording
from benchnav.eval.report.layers import SOFT, field_colours, hatching, outline, shades

_LIFT_M = 0.12
_CLOSED = (240, 240, 240)


def log_terrain(stream: Any, recording: Recording) -> None:
    """Logs the ground as a mesh, once for all times."""
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


def log_maps(stream: Any, recording: Recording) -> None:
    """Logs the maps that are no planner's own: colour, soft ground, λ in truth."""
    import rerun as rr

    grid = recording.grid
    log_image(stream, "map/colour", np.moveaxis(recording.rgb, 0, -1))
    log_image(stream, "map/true_mean", shades(recording.true_mean))
    if recording.field is not None:
        log_image(stream, "map/field", field_colours(recording.field, recording.immobilising))
    if recording.soft.any():
        for name, lines in (("outline", outline), ("hatching", hatching)):
            drawn = lines(recording.soft, grid.resolution_m)
            flat = on_map(grid, drawn.reshape(-1, 2)).reshape(-1, 2, 2)
            stream.log(f"map/soft/{name}", rr.LineStrips2D(flat, colors=[SOFT], radii=0.06), static=True)
    for name, position in (("start", recording.states[0, :2]), ("goal", recording.goal_m)):
        place, colour = position[None].astype(np.float32), bytes_of(MARKS[name]["color"])
        stream.log(
            f"world/{name}",
            rr.Points3D(over_ground(recording, place), radii=0.35, colors=[colour]),
            static=True,
        )
        stream.log(
            f"map/places/{name}", rr.Points2D(on_map(grid, place), radii=0.7, colors=[colour]), static=True
        )


def log_predicted(stream: Any, recording: Recording, risk: str, closed: str) -> None:
    """Logs the λ̂ that a planner was given, and the edge of ground that is not free.

    Args:
        stream: a recording stream of Rerun's.
        recording: the planner's.
        risk: entity of the map.
        closed: entity of the edge.
    """
    import rerun as rr

    image = shades(recording.predicted)
    image[~recording.free] = 64
    log_image(stream, risk, image)
    edges = outline(~recording.free, recording.grid.resolution_m)
    flat = on_map(recording.grid, edges.reshape(-1, 2)).reshape(-1, 2, 2)
    stream.log(closed, rr.LineStrips2D(flat, colors=[_CLOSED], radii=0.08), static=True)


def log_image(stream: Any, entity: str, image: np.ndarray) -> None:
    """Logs a map, uint8 of shape [H, W, 3], as an image; images have their first row at the top."""
    import rerun as rr

    stream.log(entity, rr.Image(np.ascontiguousarray(image[::-1])), static=True)


def over_ground(recording: Recording, place: np.ndarray) -> np.ndarray:
    """Puts positions (x, y) of shape [N, 2] a little over the ground; x and y stay as they are."""
    height = recording.elevation_m[cells_of(recording.grid, place)] + _LIFT_M
    return np.concatenate((place, height[:, None]), axis=1).astype(np.float32)


def on_map(grid: Grid, place: np.ndarray) -> np.ndarray:
    """Puts positions (x, y) of shape [N, 2] on the images."""
    return np.stack((place[:, 0] / grid.resolution_m, grid.height - place[:, 1] / grid.resolution_m), axis=1)


def cells_of(grid: Grid, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the cells that positions lie in, or of the nearest ones."""
    cell = np.floor(place / grid.resolution_m).astype(int)
    return cell[:, 1].clip(0, grid.height - 1), cell[:, 0].clip(0, grid.width - 1)
