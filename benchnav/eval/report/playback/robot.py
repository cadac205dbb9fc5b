"""What belongs to one robot of a recording in the Rerun viewer: where it is, what it planned, drove and met."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchnav.eval.recording import Recording, drawing_interval, thinned
from benchnav.eval.report.layers import STYLES, shades
from benchnav.eval.report.playback.scene import cells_of, on_map, over_ground

TIMELINE = "time"

_RADIUS_M, _RADIUS_CELLS = 0.02, 0.06
_HEADING_M = 1.2
# Plans drawn until a new piece of the driven path is begun: at each plan all of a piece is logged.
_PIECE = 10
# An X in one stroke, and its half width.
_CROSS = np.array([(-1, -1), (1, 1), (0, 0), (-1, 1), (1, -1)], dtype=np.float32)
_CROSS_M = 1.0
_MARK, _EDGE = (255, 255, 255), (0, 0, 0)


@dataclass(frozen=True, kw_only=True)
class Driver:
    """One robot of a recording.

    Args:
        recording: its episode.
        name: unlike those of the others; empty where it is alone.
        colour: red, green, blue, in [0, 255].
    """

    recording: Recording
    name: str
    colour: tuple[int, int, int]

    def entity(self, root: str, leaf: str = "") -> str:
        """Path of what is the robot's own under a root."""
        import rerun as rr

        own = ["conditions", rr.escape_entity_path_part(self.name)] if self.name else []
        return "/".join([root, *own, *([leaf] if leaf else [])])


def log_robot(stream: Any, driver: Driver) -> None:
    """Logs where the robot is and where it heads, at every step."""
    import rerun as rr

    recording = driver.recording
    states = recording.states
    times = rr.TimeColumn(TIMELINE, duration=np.arange(len(states)) * recording.dt_s)
    place = states[:, :2].astype(np.float32)
    lifted, flat = over_ground(recording, place), on_map(recording.grid, place)
    cos, sin, none = np.cos(states[:, 2]), np.sin(states[:, 2]), np.zeros(len(states))
    ahead = _HEADING_M * np.stack((cos, sin, none), axis=1)
    ahead_flat = _HEADING_M / recording.grid.resolution_m * np.stack((cos, -sin), axis=1)
    for root, points, vectors, dots, arrows, radius in (
        ("world", lifted, ahead, rr.Points3D, rr.Arrows3D, 0.3),
        ("map/overlay", flat, ahead_flat, rr.Points2D, rr.Arrows2D, 0.7),
    ):
        robot, heading = driver.entity(root, "robot"), driver.entity(root, "heading")
        stream.send_columns(robot, [times], dots.columns(positions=points))
        stream.send_columns(heading, [times], arrows.columns(origins=points, vectors=vectors))
        stream.log(robot, dots.from_fields(radii=[radius], colors=[driver.colour]), static=True)
        stream.log(heading, arrows.from_fields(radii=[radius / 3], colors=[driver.colour]), static=True)


def log_series(stream: Any, driver: Driver) -> None:
    """Logs observed λ and predicted, the threshold of free ground, the distance to the goal, and commands."""
    import rerun as rr

    recording = driver.recording
    place = recording.states[:-1, :2].astype(np.float32)
    times = rr.TimeColumn(TIMELINE, duration=np.arange(len(place)) * recording.dt_s)
    what = {
        "traversability": (recording.traversability, "met"),
        "goal": (np.linalg.norm(place - recording.goal_m, axis=1), "distance"),
    }
    lines = {driver.entity(f"series/{kind}", name): values for kind, (values, name) in what.items()}
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
            style = rr.SeriesLines(colors=[driver.colour], names=[driver.name])
            stream.log(entity, style, static=True)


def log_driven(stream: Any, driver: Driver) -> None:
    """Logs the path driven so far, coloured by the observed λ, or in the robot's colour where it is not alone."""
    recording = driver.recording
    place = recording.states[:, :2].astype(np.float32)
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
            _log_strips(stream, driver, f"driven/{piece:03}", lines, shown, (0.08, 0.25))


def log_plans(stream: Any, driver: Driver) -> None:
    """Logs what was planned, when it was planned; of a robot that is not alone, the path alone."""
    known: dict[str, list[np.ndarray]] = {}
    for plan in map(thinned, driver.recording.own_plans):
        stream.set_time(TIMELINE, duration=plan.step * driver.recording.dt_s)
        for name, style in STYLES.items():
            lines = list(plan.lines.get(name, ()))
            # A layer without lines is logged too: it wipes out the earlier plan's. One that stays is not.
            if (driver.name and name != "path") or (name in known and _same(known[name], lines)):
                continue
            known[name] = lines
            colours = [(*driver.colour, 160) if driver.name else style.colour]
            radii = (_RADIUS_M * style.width, _RADIUS_CELLS * style.width)
            _log_strips(stream, driver, f"plan/{name}", lines, colours, radii)


def _log_strips(
    stream: Any,
    driver: Driver,
    leaf: str,
    lines: Sequence[np.ndarray],
    colours: Any,
    radii: tuple[float, float],
) -> None:
    """Logs lines, each of shape [N, 2], over the ground and on the maps; the radii are in metres and in cells."""
    import rerun as rr

    recording = driver.recording
    lifted = [over_ground(recording, line) for line in lines]
    flat = [on_map(recording.grid, line) for line in lines]
    stream.log(driver.entity("world", leaf), rr.LineStrips3D(lifted, colors=colours, radii=radii[0]))
    stream.log(driver.entity("map/overlay", leaf), rr.LineStrips2D(flat, colors=colours, radii=radii[1]))


def _same(first: list[np.ndarray], second: list[np.ndarray]) -> bool:
    return len(first) == len(second) and all(map(np.array_equal, first, second))


def log_outcome(stream: Any, driver: Driver) -> None:
    """Says how the episode ended where it ended, from that moment on, and marks a robot that was held."""
    import rerun as rr

    recording = driver.recording
    end = recording.states[-1:, :2].astype(np.float32)
    words = [f"{driver.name}: {recording.outcome}" if driver.name else recording.outcome]
    lifted, flat = over_ground(recording, end), on_map(recording.grid, end)
    lifted[:, 2] += 0.6
    stream.set_time(TIMELINE, duration=recording.end_s)
    for root, mark in (
        ("world", rr.Points3D(lifted, labels=words, show_labels=True, colors=[driver.colour], radii=0.05)),
        ("map/overlay", rr.Points2D(flat, labels=words, show_labels=True, colors=[driver.colour], radii=0.1)),
    ):
        stream.log(driver.entity(root, "outcome"), mark)
    place = recording.immobilised_at
    if place is None:
        return
    cross = (place + _CROSS_M * _CROSS).astype(np.float32)
    lifted, flat = over_ground(recording, cross), on_map(recording.grid, cross)
    lifted[:, 2] += 0.3
    for entity, crossed in (
        (driver.entity("world", "immobilised"), rr.LineStrips3D([lifted], colors=[_MARK], radii=0.12)),
        (
            driver.entity("map/overlay", "immobilised/edge"),
            rr.LineStrips2D([flat], colors=[_EDGE], radii=0.55, draw_order=40),
        ),
        (
            driver.entity("map/overlay", "immobilised/cross"),
            rr.LineStrips2D([flat], colors=[_MARK], radii=0.3, draw_order=41),
        ),
    ):
        stream.log(entity, crossed)
