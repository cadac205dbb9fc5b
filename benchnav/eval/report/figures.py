"""What all figures of a run share: names, the colours of λ, and how they are saved."""

from pathlib import Path

from matplotlib.figure import Figure

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


def save(figure: Figure, path: Path) -> None:
    """Writes a figure, whole or not at all.

    Args:
        figure: what was drawn.
        path: file; its suffix says the format.
    """
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150, format=path.suffix[1:], bbox_inches="tight")
