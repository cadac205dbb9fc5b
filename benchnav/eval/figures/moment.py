"""Maps, plan and driven path at one step of an episode, for figures and playback.

Letters in shapes: H×W cells.
"""

import numpy as np
from matplotlib.axes import Axes

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.recording import Recording
from benchnav.viz import drives, maps, plans
from benchnav.viz.bodies import draw_body
from benchnav.viz.style import bytes_of

CLOSE_UP_M = 5.0  # edge length of a close-up
# RGB colours of unobserved cells, observed cells, and cells with measured λ.
_SEEN_COLOURS = np.array(
    [bytes_of(colour)[:3] for colour in (maps.UNSEEN, maps.SEEN, maps.SENSED)], np.uint8
)


def has_ended(recording: Recording, step: int) -> bool:
    """Return whether an episode has ended at a step."""
    return step == len(recording.traversability)


def known_colours(recording: Recording, step: int) -> dict[str, np.ndarray]:
    """Return colours of the planner's maps at a step.

    Returns:
        Colours by name, uint8, each of shape [H, W, 3]. `risk` is λ̂ with non-free
        cells. If the robot learns, `mean` and `spread` show the belief, and these
        three are veiled in unobserved cells; `seen` is light in observed cells and blue
        in cells with measured λ.
    """
    predicted, free = recording.given_at(step)
    risk = maps.shades(predicted)
    risk[~free] = bytes_of(maps.CLOSED)[:3]
    known_map = recording.known_at(step)
    if known_map is None:
        return {"risk": risk}
    spread = maps.shades(known_map.spread / maps.MAX_SPREAD, maps.SPREAD_COLOURS)
    colours = {"risk": risk, "mean": maps.shades(known_map.mean), "spread": spread}
    veiled = {
        name: maps.veiled(shown, known_map.seen) for name, shown in colours.items()
    }
    # λ may be measured in a cell whose appearance was not observed.
    kind = np.where(known_map.sensed, 2, known_map.seen.astype(int))
    return veiled | {"seen": _SEEN_COLOURS[kind]}


def true_colours(recording: Recording) -> np.ndarray:
    """Return colours of the λ field and its immobilising cells, uint8, [H, W, 3].

    If λ is resampled, the colours show E[λ].
    """
    if recording.field is None:
        return maps.shades(recording.true_mean)
    return maps.field_colours(recording.field, recording.immobilising)


def show_known(
    panel: Axes, recording: Recording, step: int, name: str = "risk"
) -> None:
    """Show a map of `known_colours`, with unobserved cells and the sensors' footprint.

    Args:
        panel: axes to draw on.
        recording: recording of the episode.
        step: index of the step.
        name: key of `known_colours`.
    """
    colours = known_colours(recording, step)[name]
    maps.show_map(panel, colours, recording.grid.extent_m)
    known_map = recording.known_at(step)
    _, free = recording.given_at(step)
    if name == "risk" and not free.all():
        maps.name_terrain(panel, "not free", color=maps.CLOSED)
    if known_map is None:
        return
    unseen = ~known_map.seen
    if unseen.any():
        lines = maps.hatching(unseen, recording.resolution_m)
        maps.draw_lines(panel, lines, "black", 0.3)
        look = {"fc": maps.UNSEEN, "ec": "black", "hatch": "////"}
        maps.name_terrain(panel, "not observed", lw=0, **look)
    if known_map.outlines:
        plans.draw_footprint(panel, known_map.outline)


def known_in_words(recording: Recording) -> str:
    """Return the title of the map of λ̂ that `show_known` shows."""
    if recording.about["model"] == NOT_USED:
        return "true E[λ]; the planner uses no map"
    if recording.known:
        return "λ̂ of the belief at that time"
    sees_all = recording.about.get("sensor", "full") == "full"
    is_static = recording.about.get("belief", "static") == "static"
    if sees_all and is_static:
        return "λ̂ given to the planner"
    return "λ̂ at the start"  # updates were not recorded


def show_truth(panel: Axes, recording: Recording) -> None:
    """Show the map of `true_colours`."""
    maps.show_map(panel, true_colours(recording), recording.grid.extent_m)
    if recording.field is not None:
        maps.name_immobilising(panel, recording.immobilising)


def draw_plan(panel: Axes, recording: Recording, step: int) -> None:
    """Draw the plan of a step; draw nothing if the episode has ended."""
    if not has_ended(recording, step):
        plan = recording.plan_at(step * recording.dt_s)
        plans.draw_plan(panel, plan.lines)


def draw_close_up(panel: Axes, recording: Recording, step: int) -> None:
    """Draw a robot with a footprint in its size on the true map, with wheel tracks.

    Args:
        panel: axes to draw on; the robot is in its middle.
        recording: recording of the episode, with contacts.
        step: index of the step.
    """
    contacts_m = recording.contacts_m
    assert contacts_m is not None
    show_truth(panel, recording)
    x, y = recording.track[step].astype(float)
    half = CLOSE_UP_M / 2
    panel.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    for wheel_track in np.moveaxis(contacts_m[: step + 1], 1, 0):
        panel.plot(*wheel_track.T, color="black", lw=0.5, label="_wheel track")
    ruts_m = None if recording.ruts_m is None else recording.ruts_m[step]
    pose = recording.states[step, :3]
    draw_body(panel, pose, contacts_m[step], ruts_m, "_robot")


def drive_at(recording: Recording, step: int) -> drives.Drive:
    """Return the path of a recording up to a step."""
    outcome = recording.about["outcome"] if has_ended(recording, step) else ""
    contacts_m = recording.contacts_m
    ruts_m = recording.ruts_m
    return drives.Drive(
        track=recording.track[: step + 1],
        goal_m=recording.goal_m,
        outcome=outcome,
        heading_rad=recording.states[step, 2],
        contacts_m=None if contacts_m is None else contacts_m[step],
        ruts_m=None if ruts_m is None else ruts_m[step],
    )
