"""Sheets of maps for a page: one row per map and one column per layer.

Lengths are in inches and text sizes in points, as printed over both columns of a page.
Letters in shapes: R rows; C classes; H×W cells.
"""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from benchnav.core.grid import is_azimuth
from benchnav.viz.maps import (
    LAMBDA,
    MISSING,
    frame_map,
    layer_scale,
    show_map,
    with_missing,
)
from benchnav.viz.style import TEXT, TWO_COLUMNS_IN, legend_outside, styled

_MAX_HEIGHT = 9.4  # maximum height of a sheet
_DPI = 300.0
_SIDES, _ENDS = 0.7, 1.5  # width and height of everything in a sheet except maps
LINE, LETTER = 0.135, 0.054  # height of a line of text, and mean width of a letter
_MIN_COLUMN = 1.15  # minimum width of a column
_BAR_GAP = 0.08  # distance between a column and its colour bar
_TITLE_LETTERS = 20  # number of letters per line of a column's title
FRACTIONS: dict[str, Any] = {**LAMBDA, "cmap": with_missing("viridis")}


class SheetColumn(NamedTuple):
    """A column of a sheet of maps.

    Args:
        name: name of the column. The axes' labels, by which tests find them, are
            `NAME ROW` for a panel and `NAME bar` for the colour bar.
        title: heading of the column.
        layers: map of each row, shape [R, H, W], or colours of shape [R, H, W, 3].
        shades: keywords of `Axes.imshow` for the colours.
        unit: label below the colour bar; if None, there is no bar.
        extend: ends of the bar that values may exceed: `neither`, `max` or `both`.
        max_intervals: maximum number of intervals between the bar's ticks.
    """

    name: str
    title: str
    layers: np.ndarray
    shades: Mapping[str, Any] = {}
    unit: str | None = None
    extend: str = "neither"
    max_intervals: int = 4


def layer_column(name: str, values: np.ndarray, unit: str) -> SheetColumn:
    """Return a column of a sheet for a layer.

    Args:
        name: name of the layer.
        values: values of the layer, shape [R, H, W].
        unit: unit of the values; "1" for values without a unit.
    """
    words = name.removesuffix(f"_{unit}").replace("_", " ")
    unit_text = {"1": "", "deg": " [°]"}.get(unit, f" [{unit}]")
    title = words[:1].upper() + words[1:] + unit_text
    title = textwrap.fill(title, _TITLE_LETTERS, break_long_words=False)
    shown = values % 360 if is_azimuth(name) else values
    layers = np.ma.masked_invalid(shown)
    return SheetColumn(name, title, layers, layer_scale(name, values), "")


@styled()
def sheet_of_maps(
    columns: Sequence[SheetColumn],
    rows: Sequence[str],
    extent_m: tuple[float, float],
    heading: str,
    classes: Sequence[Artist],
    marks: Sequence[Artist] = (),
) -> Figure:
    """Draw a sheet of maps: one row per map and one column per layer.

    Args:
        columns: columns of the sheet, each with R maps.
        rows: names of the R rows.
        extent_m: size of a map along x and y, in metres.
        heading: heading of the sheet.
        classes: entries of the legend of terrain classes below the maps; may be empty.
        marks: entries of a legend next to the heading; may be empty.

    Returns:
        A figure as wide as a page. It is narrower if panels shrink to fit the page's
        height, and wider if there are many columns.
    """
    ratio = extent_m[1] / extent_m[0]
    n_rows = len(rows)
    n_columns = len(columns)
    max_panel_width = max((TWO_COLUMNS_IN - _SIDES) / n_columns, _MIN_COLUMN)
    max_panel_height = max((_MAX_HEIGHT - _ENDS) / n_rows, 0.8)
    panel_height = min(max_panel_width * ratio, 2.0, max_panel_height)
    width = n_columns * max(panel_height / ratio, _MIN_COLUMN) + _SIDES
    letters = max((len(str(patch.get_label())) for patch in classes), default=0)
    legend_columns = max(1, int(width / (0.4 + LETTER * letters)))
    legend_lines = -(-len(classes) // legend_columns)
    ends = _ENDS + LINE * legend_lines
    height = n_rows * max(panel_height, 0.5) + ends
    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    shared: dict[str, Any] = {"sharex": True, "sharey": True}
    panels = figure.subplots(n_rows, n_columns, squeeze=False, **shared)
    for column, column_panels in zip(columns, panels.T, strict=True):
        image = _draw_column(column, column_panels, extent_m)
        if column.unit is not None:
            # Matplotlib expects the gap as a fraction of the height of all maps.
            gap = _BAR_GAP / (height - ends)
            _draw_bar(figure, column, image, list(column_panels), gap)
    _set_ticks(panels[0, 0].xaxis, panel_height / ratio)
    _set_ticks(panels[0, 0].yaxis, panel_height)
    for panel, name in zip(panels[:, 0], rows, strict=True):
        panel.set_ylabel(name, size=TEXT)
    panels[-1, n_columns // 2].set_xlabel("x [m]", size=TEXT)
    figure.supylabel("y [m]", size=TEXT, y=0.5 + (ends / 2 - 0.45) / height)
    figure.suptitle(heading, x=0.01, ha="left", parse_math=False)
    if marks:
        _add_legend(figure, marks, len(marks), "upper right")
    if classes:
        _add_legend(figure, classes, legend_columns, "lower left")
    return figure


def _draw_column(
    column: SheetColumn, panels: Sequence[Axes], extent_m: tuple[float, float]
) -> Any:
    """Draw the maps of a column from top to bottom; return the last image."""
    for row, panel in enumerate(panels):
        panel.set(label=f"{column.name} {row}", facecolor=MISSING)
        image = show_map(panel, column.layers[row], extent_m, **column.shades)
        frame_map(panel)
    panels[0].set_title(column.title)
    return image


def _draw_bar(
    figure: Figure, column: SheetColumn, image: Any, panels: list[Axes], gap: float
) -> None:
    """Draw the colour bar of a column below the column's panels.

    Args:
        figure: figure with the panels.
        column: the column.
        image: image of any of the column's maps.
        panels: panels of the column.
        gap: distance from the panels, as a fraction of their total height.
    """
    ticks = MaxNLocator(column.max_intervals, steps=[1, 2, 2.5, 5, 10])
    bar = figure.colorbar(
        image,
        ax=panels,
        location="bottom",
        pad=gap,
        extend=column.extend,
        aspect=14,
        panchor=False,
        ticks=ticks,
        format="%g",
    )
    bar.set_label(str(column.unit), size=TEXT)
    bar.ax.set_label(f"{column.name} bar")


def _set_ticks(axis: Axis, length_in: float) -> None:
    """Place the ticks of an axis whose length is `length_in` inches."""
    max_intervals = min(max(int(length_in / 0.2), 1), 4)
    # Omit a tick at the upper end, whose number would touch that of the next panel.
    locator = MaxNLocator(max_intervals, steps=[1, 2, 5, 10], prune="upper")
    axis.set_major_locator(locator)


def _add_legend(
    figure: Figure, handles: Sequence[Artist], columns: int, side: str
) -> None:
    for text in legend_outside(figure, handles, columns, side).get_texts():
        text.set_parse_math(False)


def class_patches(names: Sequence[str], colours: np.ndarray) -> list[Artist]:
    """Return legend entries of terrain classes.

    Args:
        names: names of the C classes.
        colours: colours of the classes, shape [C, 3].
    """
    return [
        Patch(facecolor=colour, ec="0.3", lw=0.4, label=name)
        for colour, name in zip(colours, names, strict=True)
    ]


def class_scale(colours: np.ndarray) -> dict[str, Any]:
    """Return the colour scale of class indices, as keywords of `Axes.imshow`.

    Masked cells have no class.

    Args:
        colours: colours of the classes, shape [C, 3].
    """
    return {"cmap": with_missing(colours), "vmin": -0.5, "vmax": len(colours) - 0.5}
