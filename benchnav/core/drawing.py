"""What all figures share: sizes as printed, places in inches, and how they are saved."""

from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

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


def settle(figure: Figure, dpi: float) -> None:
    """Lays a figure out for good, so that each file of it is drawn alike, and no layout is made twice.

    Args:
        figure: what was drawn, with an engine of layout.
        dpi: dots an inch, from now on its own.
    """
    figure.set_dpi(dpi)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)


def trimmed(figure: Figure) -> Bbox:
    """The part of a figure that is not its white borders, in inches, with a little space around it."""
    return Bbox(figure.get_tightbbox()).padded(matplotlib.rcParams["savefig.pad_inches"])


def save(
    figure: Figure, path: Path, kind: str, dpi: float | str = "figure", part: Bbox | None = None
) -> None:
    """Writes a figure with its fonts embedded.

    Args:
        figure: what was drawn.
        path: file to write.
        kind: png, pdf, svg or jpg.
        dpi: dots an inch; those of the figure where not given.
        part: what of it is written, in inches; all where not given.
    """
    with matplotlib.rc_context(_SAVED):
        figure.savefig(path, format=kind, dpi=dpi, bbox_inches=part)
