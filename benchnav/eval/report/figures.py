"""What all figures of a run share: names, the colours of λ, and how they are saved."""

from collections.abc import Collection, Mapping
from pathlib import Path

from matplotlib.figure import Figure

from benchnav.eval.trial import NOT_USED
from benchnav.files import replacing

# As on map sheets and previews; told apart by the colour-blind too.
TRAVERSABILITY_COLOURS = "viridis"

_NAMES = {
    "astar_dwa": "A* + DWA",
    "astar_mppi": "A* + MPPI",
    "cl_rrt": "CL-RRT",
    "mppi": "MPPI",
    "straight": "straight",
}


def display_name(planner: str) -> str:
    """What figures call a planner, from its label."""
    return _NAMES.get(planner, planner)


def trial_name(labels: Mapping[str, str], several: Collection[str]) -> str:
    """What figures call a trial: its planner and its risk setting, and what else tells it from others.

    Args:
        labels: of the trial; what it does not use is `NOT_USED`.
        several: labels that differ among the trials shown, of `model` and `world`.
    """
    told = [labels[name] for name in ("model", "world") if name in several]
    # A planner that is told λ itself has a model and no risk setting; a blind one has neither.
    if labels["risk"] == NOT_USED and "model" not in several:
        told.insert(0, labels["model"])
    words = [display_name(labels["planner"]), *told, labels["risk"]]
    return ", ".join(word for word in words if word != NOT_USED)


def save(figure: Figure, path: Path) -> None:
    """Writes a figure, whole or not at all.

    Args:
        figure: what was drawn.
        path: file; its suffix says the format.
    """
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150, format=path.suffix[1:], bbox_inches="tight")
