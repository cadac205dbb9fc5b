"""What all figures of a run share: names, sizes, colours, and how they are saved."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchnav.core import drawing
from benchnav.core.store import replacing
from benchnav.eval.experiment.condition import NOT_USED

# As on map sheets and previews; distinct for the colour-blind too.
TRAVERSABILITY_COLOURS = "viridis"

# Distinct for the colour-blind too; without yellow, which is lost on white. Source: Okabe and Ito (2008).
OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")

# Widths of a journal's column and of a page.
ONE_COLUMN_IN, TWO_COLUMNS_IN = 88 / 25.4, 180 / 25.4

# For figures at the width of a column.
STYLE: dict[Any, Any] = {
    **{
        "font.size": 8,
        "axes.titlesize": 8,
        "axes.labelsize": 8,
        "figure.titlesize": 8,
        "figure.labelsize": 8,
    },
    **{"xtick.labelsize": 7, "ytick.labelsize": 7, "legend.fontsize": 7, "legend.frameon": False},
    **{"axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6, "grid.linewidth": 0.5},
    **{
        "xtick.major.size": 2.5,
        "ytick.major.size": 2.5,
        "axes.spines.top": False,
        "axes.spines.right": False,
    },
    **{"figure.constrained_layout.h_pad": 0.03, "figure.constrained_layout.w_pad": 0.03},
}

_NAMES = {
    "astar_dwa": "A* + DWA",
    "astar_mppi": "A* + MPPI",
    "cl_rrt": "CL-RRT",
    "mppi": "MPPI",
    "straight": "straight",
}
_DPI, _MOST_PIXELS = 200, 2000


def display_name(planner: str) -> str:
    """What figures call a planner, from its label."""
    return _NAMES.get(planner, planner)


def condition_name(labels: Mapping[str, str], several: Collection[str]) -> str:
    """What figures call a condition: its planner and its risk setting, and what else tells it from others.

    Args:
        labels: of the condition; what it does not use is `NOT_USED`.
        several: labels that differ among the conditions shown, of `model` and `world`.
    """
    told = [labels[name] for name in ("model", "world") if name in several]
    # A planner that is told λ itself has a model and no risk setting; a blind one has neither.
    if labels["risk"] == NOT_USED and "model" not in several:
        told.insert(0, labels["model"])
    words = [display_name(labels["planner"]), *told, labels["risk"]]
    return ", ".join(word for word in words if word != NOT_USED)


def save(figure: Figure, path: Path, trim: bool = True) -> None:
    """Writes a figure as PNG and, beside it, as PDF with its fonts embedded; each whole or not at all.

    Args:
        figure: what was drawn.
        path: of the PNG.
        trim: cut away white borders; a figure made for a column keeps its width without.
    """
    dpi = min(_DPI, _MOST_PIXELS / figure.get_figwidth())
    drawing.settle(figure, dpi)
    part = drawing.trimmed(figure) if trim else None
    for suffix in (".png", ".pdf"):
        with replacing(path.with_suffix(suffix)) as partial:
            drawing.save(figure, partial, suffix[1:], dpi, part)
