"""Robots with a footprint in the Rerun viewer: contacts, wheels, chassis and ruts.

A robot without a recorded body is a rectangle on the terrain. Letters in shapes: N
steps, W wheels or other contacts.
"""

from typing import Any

import numpy as np
import rerun as rr

from benchnav.eval.recording import Recording
from benchnav.eval.report.playback.scene import Driver, Stage, times_of
from benchnav.viz.bodies import rectangle, rut_colours

RUTS = "series/ruts"  # path of the depths of ruts

_CORNERS = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1)]) / 2
_CONTACT_M = 0.07  # radius of a contact on the terrain
_CONTACT_CELLS = 0.15
_LINE_CELLS = 0.08
_LINE_M = 0.03


def log_body(stream: Any, driver: Driver) -> None:
    """Log the footprint of a robot, and its body and ruts if they were recorded."""
    recording = driver.recording
    contacts_m = recording.contacts_m
    if contacts_m is None:
        return
    stage = Stage(stream=stream, recording=recording)
    has_body = "position_m" in recording.body
    times = times_of(recording, len(contacts_m))
    outlines = _outlines(recording, contacts_m)
    colours = _wheel_colours(recording, contacts_m)
    flat = stage.flat(contacts_m)
    _log_marks(stage, driver, "map/overlay", flat, colours, times)
    strips: Any = rr.LineStrips2D.columns(strips=stage.flat(outlines))
    look: Any = rr.LineStrips2D.from_fields(radii=[_LINE_CELLS], colors=[driver.colour])
    _log_columns(stage, driver.entity("map/overlay", "footprint"), strips, look, times)
    if has_body:
        _log_rigid_body(stage, driver, colours, times)
    else:
        _log_marks(stage, driver, "world", stage.lifted(contacts_m), colours, times)
        strips = rr.LineStrips3D.columns(strips=stage.lifted(outlines))
        look = rr.LineStrips3D.from_fields(radii=[_LINE_M], colors=[driver.colour])
        _log_columns(stage, driver.entity("world", "footprint"), strips, look, times)
    if recording.ruts_m is not None:
        _log_ruts(stage, driver, recording.ruts_m, times)


def _outlines(recording: Recording, contacts_m: np.ndarray) -> np.ndarray:
    """Return closed rectangles around the contacts, shape [N + 1, 5, 2]."""
    outlines = []
    for pose, contacts in zip(recording.states[:, :3], contacts_m, strict=True):
        centre, size, axes = rectangle(pose, contacts)
        outlines.append(pose[:2] + (centre + size * _CORNERS) @ axes)
    return np.stack(outlines).astype(np.float32)


def _wheel_colours(recording: Recording, contacts_m: np.ndarray) -> np.ndarray:
    """Return colours of wheels by the depths of their ruts, uint8, [N + 1, W, 3]."""
    ruts_m = recording.ruts_m
    if ruts_m is None:
        ruts_m = np.zeros(contacts_m.shape[:2])
    return rut_colours(ruts_m)


def _log_columns(stage: Stage, entity: str, moving: Any, look: Any, times: Any) -> None:
    """Log what changes at each step, and what does not."""
    stage.stream.send_columns(entity, [times], moving)
    stage.stream.log(entity, look, static=True)


def _log_marks(
    stage: Stage,
    driver: Driver,
    root: str,
    positions: np.ndarray,
    colours: np.ndarray,
    times: Any,
) -> None:
    """Log a point per contact, on the terrain or on the maps."""
    is_flat = positions.shape[-1] == 2
    points: Any = rr.Points2D if is_flat else rr.Points3D
    radius = _CONTACT_CELLS if is_flat else _CONTACT_M
    moving = _points(points, positions, colours)
    look = points.from_fields(radii=[radius])
    _log_columns(stage, driver.entity(root, "contacts"), moving, look, times)


def _points(archetype: Any, positions: np.ndarray, colours: np.ndarray) -> Any:
    """Return the columns of W points per step."""
    n_steps, n_points = positions.shape[:2]
    moving = archetype.columns(
        positions=positions.reshape(n_steps * n_points, -1),
        colors=colours.reshape(n_steps * n_points, -1),
    )
    return moving.partition([n_points] * n_steps)


def _log_rigid_body(
    stage: Stage, driver: Driver, colours: np.ndarray, times: Any
) -> None:
    """Log the wheels as spheres, and the chassis as a box between them."""
    body = driver.recording.body
    wheels_m = body["wheels_m"]
    radius_m = body["wheel_radius_m"]
    moving = _points(rr.Points3D, wheels_m, colours)
    look = rr.Points3D.from_fields(radii=radius_m[0])
    _log_columns(stage, driver.entity("world", "wheels"), moving, look, times)
    rotation = body["rotation"]
    offsets = (wheels_m[0] - body["position_m"][0]) @ rotation_matrix(rotation[0])
    low, high = offsets.min(axis=0), offsets.max(axis=0)
    height_m = float(radius_m[0].mean())
    half_size = [*((high - low)[:2] / 2), height_m / 2]
    centre = (low + high) / 2 + (0, 0, height_m / 2)
    box = rr.Boxes3D(
        centers=[centre],
        half_sizes=[half_size],
        colors=[driver.colour],
        fill_mode="solid",
    )
    poses = rr.Transform3D.columns(
        translation=body["position_m"], quaternion=np.roll(rotation, -1, axis=1)
    )
    _log_columns(stage, driver.entity("world", "chassis"), poses, box, times)


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the matrix from a body's axes to the world's, shape [3, 3].

    Args:
        quaternion: unit quaternion (w, x, y, z), shape [4].
    """
    w, x, y, z = quaternion.astype(np.float64)
    cross = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def _log_ruts(stage: Stage, driver: Driver, ruts_m: np.ndarray, times: Any) -> None:
    """Log depths of ruts in centimetres: of each wheel, or the deepest per robot."""
    lines = {}
    if driver.name:
        lines[driver.entity(RUTS, "deepest")] = ruts_m.max(axis=1)
    else:
        for index, depth_m in enumerate(ruts_m.T):
            lines[f"{RUTS}/wheel_{index + 1}"] = depth_m
    for entity, depth_m in lines.items():
        scalars = rr.Scalars.columns(scalars=100 * depth_m.astype(np.float64))
        stage.stream.send_columns(entity, [times], scalars)
        if driver.name:
            style = rr.SeriesLines(colors=[driver.colour], names=[driver.name])
            stage.stream.log(entity, style, static=True)
