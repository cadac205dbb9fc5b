"""What belongs to one robot of a recording in the Rerun viewer: where it is, what it planned, drove and met."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from benchnav.core.figures import bytes_of
from benchnav.eval.recording import Recording, drawing_interval, thinned
from benchnav.eval.report.plan_layers import STYLES, shades
from benchnav.eval.report.playback.scene import (
    LIFT_M,
    POINTS,
    STRIPS,
    cells_of,
    log_both,
    on_map,
    over_ground,
)

TIMELINE = "time"

_RADIUS_M, _RADIUS_CELLS = 0.02, 0.06
_HEADING_M = 1.2
# Plans drawn until a new piece of the driven path is begun: at each plan all of a piece is logged.
_PIECE = 10
# An X in one stroke, and its half width.
_CROSS = np.array([(-1, -1), (1, 1), (0, 0), (-1, 1), (1, -1)], dtype=np.float32)
_CROSS_M = 1.0
_MARK = (255, 255, 255)


@dataclass(frozen=True, kw_only=True)
class Driver:
    """One robot of a recording.

    Args:
        recording: its episode.
        name: unlike those of the others; empty where it is alone.
        colour: as Matplotlib takes it.
    """

    recording: Recording
    name: str
    colour: str

    def entity(self, root: str, *leaf: str) -> str:
        """Path of what is the robot's own under a root."""
        own = ["conditions", rr.escape_entity_path_part(self.name)] if self.name else []
        return "/".join([root, *own, *leaf])

    def entities(self, leaf: str) -> tuple[str, str]:
        """Paths of what is its own over the ground and on the maps."""
        return self.entity("world", leaf), self.entity("map/overlay", leaf)


def log_robot(stream: Any, driver: Driver) -> None:
    """Logs where the robot is and where it heads, at every step."""
    recording = driver.recording
    heading_rad = recording.states[:, 2]
    times = rr.TimeColumn(TIMELINE, duration=np.arange(len(heading_rad)) * recording.dt_s)
    lifted, flat = over_ground(recording, recording.track), on_map(recording.grid, recording.track)
    ahead = _HEADING_M * np.stack((np.cos(heading_rad), np.sin(heading_rad), 0 * heading_rad), axis=1)
    ahead_flat = ahead[:, :2] * (1, -1) / recording.resolution_m
    for robot, heading, points, vectors, dots, arrows, radius in zip(
        driver.entities("robot"), driver.entities("heading"), (lifted, flat), (ahead, ahead_flat), POINTS,
        (rr.Arrows3D, rr.Arrows2D), (0.3, 0.7), strict=True,
    ):  # fmt: skip
        stream.send_columns(robot, [times], dots.columns(positions=points))
        stream.send_columns(heading, [times], arrows.columns(origins=points, vectors=vectors))
        stream.log(robot, dots.from_fields(radii=[radius], colors=[bytes_of(driver.colour)]), static=True)
        stream.log(
            heading, arrows.from_fields(radii=[radius / 3], colors=[bytes_of(driver.colour)]), static=True
        )


def log_series(stream: Any, driver: Driver) -> None:
    """Logs observed λ and predicted, the threshold of free ground, the distance to the goal, and commands."""
    recording = driver.recording
    place = recording.track[:-1]
    times = rr.TimeColumn(TIMELINE, duration=np.arange(len(place)) * recording.dt_s)
    lines = {
        driver.entity("series/traversability", "met"): recording.traversability,
        driver.entity("series/goal", "distance"): np.linalg.norm(place - recording.goal_m, axis=1),
    }
    if not driver.name:
        lines["series/traversability/predicted"] = recording.predicted[cells_of(recording.grid, place)]
        lines["series/traversability/threshold"] = np.full(len(place), recording.free_above)
        for name, commanded in zip(recording.action_names, recording.actions.T, strict=True):
            lines[f"series/command/{rr.escape_entity_path_part(name)}"] = commanded
        named = f"free: {'mean' if recording.free_by == 'mean' else 'λ̂'} above"
        style = rr.SeriesLines(colors=[(200, 60, 60)], names=[named])
        stream.log("series/traversability/threshold", style, static=True)
    for entity, values in lines.items():
        stream.send_columns(entity, [times], rr.Scalars.columns(scalars=values.astype(np.float64)))
        if driver.name:
            style = rr.SeriesLines(colors=[bytes_of(driver.colour)], names=[driver.name])
            stream.log(entity, style, static=True)


def log_driven(stream: Any, driver: Driver) -> None:
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
            shown = [bytes_of(driver.colour)] if driver.name else colours[first:step]
            entities = driver.entities(f"driven/{piece:03}")
            log_both(stream, recording, entities, STRIPS, lines, (0.08, 0.25), colors=shown)


def log_plans(stream: Any, driver: Driver) -> None:
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
            colours = [bytes_of(driver.colour, 0.628) if driver.name else bytes_of(style.colour)]
            radii = (_RADIUS_M * style.width, _RADIUS_CELLS * style.width)
            entities = driver.entities(f"plan/{name}")
            log_both(stream, driver.recording, entities, STRIPS, lines, radii, colors=colours)


def log_outcome(stream: Any, driver: Driver) -> None:
    """Says how the episode ended where it ended, from that moment on, and marks a robot that was held."""
    recording = driver.recording
    words = [f"{driver.name}: {recording.outcome}" if driver.name else recording.outcome]
    stream.set_time(TIMELINE, duration=recording.end_s)
    log_both(
        stream, recording, driver.entities("outcome"), POINTS, [recording.track[-1]],
        (0.05, 0.1), LIFT_M + 0.6, labels=words, show_labels=True, colors=[bytes_of(driver.colour)],
    )  # fmt: skip
    if recording.immobilised_at is not None:
        cross = (recording.immobilised_at + _CROSS_M * _CROSS).astype(np.float32)
        log_both(
            stream, recording, driver.entities("immobilised"), STRIPS, [cross], (0.12, 0.3), LIFT_M + 0.3,
            colors=[_MARK],
        )  # fmt: skip
