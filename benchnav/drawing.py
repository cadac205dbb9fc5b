"""What all figures share: sizes as printed, places in inches, and how they are saved."""

from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Inches of two columns of a page, and points as printed.
PAGE_WIDTH_IN = 7.2
TEXT, TITLE = 7.0, 8.0

# Type 42 embeds whole fonts, as publishers ask; composed images would be sampled anew in a PDF.
_SAVED: dict[Any, Any] = {"pdf.fonttype": 42, "image.composite_image": False}


def add_axes(figure: Figure, place: tuple[float, float, float, float], label: str) -> Axes:
    """Adds a panel at (left, top, width, height) in inches from the upper left corner."""
    left, top, wide, high = place
    width, height = figure.get_size_inches()
    return figure.add_axes(
        (left / width, 1 - (top + high) / height, wide / width, high / height), label=label
    )


def write(figure: Figure, left: float, top: float, text: str, size: float = TEXT, **style: Any) -> None:
    """Writes text at a place in inches from the upper left corner."""
    width, height = figure.get_size_inches()
    figure.text(left / width, 1 - top / height, text, size=size, parse_math=False, **style)


def thin_ticks(panel: Axes, **style: Any) -> None:
    """Gives a panel the small ticks and thin lines of a printed page."""
    panel.tick_params(labelsize=TEXT, length=2, width=0.5, pad=1.5, **style)
    panel.spines[:].set_linewidth(0.5)


def save(figure: Figure, path: Path, kind: str, dpi: float | str = "figure", trim: bool = False) -> None:
    """Writes a figure with its fonts embedded.

    Args:
        figure: what was drawn.
        path: file to write.
        kind: png, pdf, svg or jpg.
        dpi: dots an inch; those of the figure where not given.
        trim: cut away white borders.
    """
    with matplotlib.rc_context(_SAVED):
        figure.savefig(path, format=kind, dpi=dpi, bbox_inches="tight" if trim else None)
