"""Sheets of maps for a page: a row a map and a column a layer.

Lengths are in inches from the upper left corner and text is in points, as printed over
the two columns of a page.
Letters in shapes: R rows, C classes, H×W cells.
"""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from benchnav.core.grid import is_azimuth
from benchnav.viz.maps import (
    LACKING,
    LAMBDA,
    frame_map,
    layer_scale,
    show_map,
    with_lacking,
)
from benchnav.viz.style import TEXT, TWO_COLUMNS_IN, legend_outside, styled

_PAGE, _DPI = 9.4, 300.0
_SIDES, _ENDS = 0.7, 1.5  # what is not maps of a sheet's width and height
LINE, LETTER, _COLUMN = 0.135, 0.054, 1.15
_TITLE_LETTERS = 20  # of a layer's name in a line, which a column has room for
SHARES: dict[str, Any] = {**LAMBDA, "cmap": with_lacking("viridis")}


class SheetColumn(NamedTuple):
    """A column of a sheet of maps.

    Args:
        name: its panels have the label `NAME ROW`, and its colour bar `NAME bar`.
        title: over the column.
        layers: a map a row, shape [R, H, W], or [R, H, W, 3] of colours.
        shades: keywords of `imshow`.
        unit: what stands under the colour bar; None where there is no bar.
        extend: at which ends the bar goes on: neither, max or both.
        most: intervals of the bar.
    """

    name: str
    title: str
    layers: np.ndarray
    shades: Mapping[str, Any] = {}
    unit: str | None = None
    extend: str = "neither"
    most: int = 4


def layer_column(name: str, values: np.ndarray, unit: str) -> SheetColumn:
    """A layer as a column of a sheet, of shape [R, H, W]."""
    words = name.removesuffix(f"_{unit}").replace("_", " ")
    title = (
        words[:1].upper() + words[1:] + {"1": "", "deg": " [°]"}.get(unit, f" [{unit}]")
    )
    title = textwrap.fill(title, _TITLE_LETTERS, break_long_words=False)
    shown = values % 360 if is_azimuth(name) else values
    return SheetColumn(
        name, title, np.ma.masked_invalid(shown), layer_scale(name, values), ""
    )


@styled()
def sheet_of_maps(
    columns: Sequence[SheetColumn],
    rows: Sequence[str],
    extent_m: tuple[float, float],
    heading: str,
    classes: Sequence[Artist],
    marks: Sequence[Artist] = (),
) -> Figure:
    """Draws maps side by side, a row a map and a column a layer, for the page of a
    paper.

    Args:
        columns: of R rows each.
        rows: names of the R rows.
        extent_m: size of a map along x and y.
        heading: over everything.
        classes: entries of the legend under everything.
        marks: entries of a legend beside the heading.

    Returns:
        A figure as wide as a page; narrower where panels shrink to fit one, wider where
        columns are many.
    """
    ratio, across = extent_m[1] / extent_m[0], len(columns)
    widest = max((TWO_COLUMNS_IN - _SIDES) / across, _COLUMN)
    high = min(widest * ratio, 2.0, max((_PAGE - _ENDS) / len(rows), 0.8))
    width = across * max(high / ratio, _COLUMN) + _SIDES
    letters = max((len(str(patch.get_label())) for patch in classes), default=0)
    legend_columns = max(1, int(width / (0.4 + LETTER * letters)))
    ends = _ENDS + LINE * -(-len(classes) // legend_columns)
    height = len(rows) * max(high, 0.5) + ends
    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    panels = figure.subplots(len(rows), across, squeeze=False, sharex=True, sharey=True)
    for column, below in zip(columns, panels.T, strict=True):
        for row, panel in enumerate(below):
            panel.set(label=f"{column.name} {row}", facecolor=LACKING)
            image = show_map(panel, column.layers[row], extent_m, **column.shades)
            frame_map(panel)
        below[0].set_title(column.title)
        if column.unit is not None:
            bar = figure.colorbar(
                image,
                ax=list(below),
                location="bottom",
                extend=column.extend,
                aspect=14,
                panchor=False,
                ticks=MaxNLocator(column.most, steps=[1, 2, 2.5, 5, 10]),
                format="%g",
            )
            bar.set_label(column.unit, size=TEXT)
            bar.ax.set_label(f"{column.name} bar")
    for axis, inches in (
        (panels[0, 0].xaxis, high / ratio),
        (panels[0, 0].yaxis, high),
    ):
        # A tick at the very end is left out, as its number would touch the next panel's
        # first.
        most = min(max(int(inches / 0.2), 1), 4)
        axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 5, 10], prune="upper"))
    for panel, name in zip(panels[:, 0], rows, strict=True):
        panel.set_ylabel(name, size=TEXT)
    panels[-1, across // 2].set_xlabel("x [m]", size=TEXT)
    figure.supylabel("y [m]", size=TEXT, y=0.5 + (ends / 2 - 0.45) / height)
    figure.suptitle(heading, x=0.01, ha="left", parse_math=False)
    for handles, count, side in (
        (marks, len(marks), "upper right"),
        (classes, legend_columns, "lower left"),
    ):
        if handles:
            for text in legend_outside(figure, handles, count, side).get_texts():
                text.set_parse_math(False)
    return figure


def class_patches(names: Sequence[str], colours: np.ndarray) -> list[Artist]:
    """Entries of a legend for classes, whose colours are of shape [C, 3]."""
    return [
        Patch(facecolor=c, ec="0.3", lw=0.4, label=n)
        for c, n in zip(colours, names, strict=True)
    ]


def class_scale(colours: np.ndarray) -> dict[str, Any]:
    """Return how class ids are coloured, as keywords of `imshow`; masked cells have no
    class.

    Args:
        colours: of the classes, shape [C, 3].
    """
    return {"cmap": with_lacking(colours), "vmin": -0.5, "vmax": len(colours) - 0.5}
