"""What an episode shows at a step: maps, plan, driven path. Figures, videos and viewer
files show the same.

Letters in shapes: H×W cells.
"""

import numpy as np
from matplotlib.axes import Axes

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.recording import Recording
from benchnav.viz import maps
from benchnav.viz.style import bytes_of

_SEEN_COLOURS = np.array(
    [bytes_of(colour)[:3] for colour in (maps.UNSEEN, maps.SEEN, maps.SENSED)], np.uint8
)


def has_ended(recording: Recording, step: int) -> bool:
    """Return whether an episode ended by a step."""
    return step == len(recording.traversability)


def known_colours(recording: Recording, step: int) -> dict[str, np.ndarray]:
    """Colour what the planner knew at a step, uint8 of shape [H, W, 3] each.

    Returns:
        `risk`, λ̂ with what is not free. Of a robot that learns also `mean` and
        `spread` of the belief, all three under a veil where the map was not seen; and
        `seen`, light where it was seen and blue where λ was sensed.
    """
    predicted, free = recording.given_at(step)
    risk = maps.shades(predicted)
    risk[~free] = bytes_of(maps.CLOSED)[:3]
    known = recording.known_at(step)
    if known is None:
        return {"risk": risk}
    spread = maps.shades(known.spread / maps.MAX_SPREAD, maps.SPREAD_COLOURS)
    colours = {"risk": risk, "mean": maps.shades(known.mean), "spread": spread}
    veiled = {name: maps.veiled(shown, known.seen) for name, shown in colours.items()}
    # A cell may be sensed that was not seen.
    return veiled | {
        "seen": _SEEN_COLOURS[np.where(known.sensed, 2, known.seen.astype(int))]
    }


def true_colours(recording: Recording) -> np.ndarray:
    """Colour the λ field with what immobilises a robot; the true mean of λ where it was
    resampled.
    """
    if recording.field is None:
        return maps.shades(recording.true_mean)
    return maps.field_colours(recording.field, recording.immobilising)


def show_known(
    panel: Axes, recording: Recording, step: int, name: str = "risk"
) -> None:
    """Show a map of `known_colours`, with what was not seen hatched and how far the
    sensors reached.
    """
    maps.show_map(panel, known_colours(recording, step)[name], recording.grid.extent_m)
    known, (_, free) = recording.known_at(step), recording.given_at(step)
    if name == "risk" and not free.all():
        maps.name_terrain(panel, "not free", color=maps.CLOSED)
    if known is None:
        return
    if not known.seen.all():
        maps.draw_lines(
            panel, maps.hatching(~known.seen, recording.resolution_m), "black", 0.3
        )
        maps.name_terrain(
            panel, "not seen", fc=maps.UNSEEN, ec="black", hatch="////", lw=0
        )
    if known.outlines:
        maps.draw_reach(panel, known.outline)


def known_in_words(recording: Recording) -> str:
    """Say what the map of λ̂ is that `show_known` shows."""
    if recording.about["model"] == NOT_USED:
        return "true E[λ]; the planner uses no map"
    if recording.known:
        return "λ̂ known by then"
    learns = (
        recording.about.get("sensor", "full"),
        recording.about.get("belief", "static"),
    ) != (
        "full",
        "static",
    )
    # what was learnt was not recorded
    return "λ̂ at the start" if learns else "λ̂ given to the planner"


def show_truth(panel: Axes, recording: Recording) -> None:
    """Show the map of `true_colours`."""
    maps.show_map(panel, true_colours(recording), recording.grid.extent_m)
    if recording.field is not None:
        maps.name_immobilising(panel, recording.immobilising)


def draw_plan(panel: Axes, recording: Recording, step: int) -> None:
    """Draw what was planned at a step; nothing once the episode has ended."""
    if not has_ended(recording, step):
        maps.draw_plan(panel, recording.plan_at(step * recording.dt_s).lines)


def drive_at(recording: Recording, step: int) -> maps.Drive:
    """Return the path of a recording up to a step."""
    return maps.Drive(
        track=recording.track[: step + 1],
        goal_m=recording.goal_m,
        outcome=recording.about["outcome"] if has_ended(recording, step) else "",
        heading_rad=recording.states[step, 2],
    )
