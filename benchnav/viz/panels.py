"""Panels that show numbers: grids of panels, curves over a swept value, intervals."""

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchnav.viz.style import (
    LINE_COLOURS,
    MARKERS,
    ONE_COLUMN_IN,
    TWO_COLUMNS_IN,
    line_style,
    stack_panels,
)

Looks = Mapping[str, Mapping[str, Any]]
GRID = "0.9"  # colour of grid lines
_LETTER_IN = 0.064  # mean width of a letter of a title
_LINE_IN = 0.13  # height of a line of a title


def line_looks(
    names: Sequence[str], colours: Sequence[Any] = (), dashed: bool = False
) -> dict[str, dict[str, Any]]:
    """Return the style of each line, as keywords of `Axes.plot`.

    Args:
        names: names of the lines; lines of the same name have the same style.
        colours: colour of each distinct name; if empty, `LINE_COLOURS` in turn.
        dashed: whether lines differ in their dashes, in addition to colours, instead of
            in their markers.
    """
    looks: dict[str, dict[str, Any]] = {}
    for index, name in enumerate(dict.fromkeys(names)):
        turn, colour_index = divmod(index, len(LINE_COLOURS))
        colour = colours[index] if colours else LINE_COLOURS[colour_index]
        look = {"color": colour, "lw": 1.1, "ls": line_style(index)}
        if not dashed:
            marker = MARKERS[index % len(MARKERS)]
            look |= {"marker": marker, "ms": 3.5, "ls": line_style(turn)}
        looks[name] = look
    return looks


def panel_grid(
    titles: Sequence[str],
    across: int,
    high_in: float,
    ends_in: float = 0.5,
    width_in: float = 0.0,
    layers: int = 1,
    **shared: Any,
) -> tuple[Figure, list[list[Axes]]]:
    """Create a figure with a titled stack of panels for each title, row by row.

    Args:
        titles: titles of the stacks, which are broken into lines that fit.
        across: maximum number of stacks next to each other.
        high_in: height of a stack in inches.
        ends_in: height of everything except the stacks, such as the legend, in inches.
        width_in: width of the figure in inches. If 0, the width is that of one column of
            a page if stacks are only above each other, else of both columns.
        layers: number of panels in a stack.
        **shared: keywords of Matplotlib's `Figure.subplots`, such as `sharex`.

    Returns:
        The figure, and the panels of each stack from top to bottom.
    """
    across = max(1, min(across, len(titles)))
    if not width_in:
        width_in = ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN
    n_rows = -(-len(titles) // across)
    letters = int(width_in / across / _LETTER_IN)
    lines = [_lines_of(title, letters) for title in titles]
    n_given = [title.count("\n") + 1 for title in titles]
    more_lines = max(
        len(now) - given for now, given in zip(lines, n_given, strict=True)
    )
    high_in += _LINE_IN * more_lines
    size = (width_in, high_in * n_rows + ends_in)
    figure = Figure(figsize=size, layout="constrained")
    stacks = stack_panels(figure, len(titles), across, layers, **shared)
    for (panel, *_), title_lines in zip(stacks, lines, strict=True):
        panel.set_title("\n".join(title_lines), parse_math=False)
    return figure, stacks


def _lines_of(title: str, letters: int) -> list[str]:
    """Return the lines of a title, broken after at most a number of letters."""
    lines: list[str] = []
    for line in title.split("\n"):
        lines += textwrap.wrap(line, letters) or [""]
    return lines


def draw_estimates(
    panel: Axes,
    x: Any,
    y: Any,
    low: Any,
    high: Any,
    look: Mapping[str, Any],
    label: str = "",
    bars: bool = False,
) -> None:
    """Draw estimates as a line, and their intervals as a band or bars.

    Args:
        panel: panel to draw on.
        x: swept values, shape [N].
        y: estimates, shape [N].
        low: lower ends of the intervals, NaN for points without an interval, shape [N].
        high: upper ends of the intervals, shape [N].
        look: keywords of `Axes.plot` for the line, including `color`.
        label: text of the legend entry; if empty, the line has no entry.
        bars: whether intervals are bars instead of a band.
    """
    if bars:
        panel.vlines(x, low, high, color=look["color"], lw=0.7)
    else:
        panel.fill_between(x, low, high, color=look["color"], alpha=0.15, lw=0)
    panel.plot(x, y, label=label or "_line", **look)


def draw_interval(
    panel: Axes, low: float, high: float, height: float, colour: Any, width: float = 1.2
) -> None:
    """Draw an interval as a horizontal line.

    Args:
        panel: panel to draw on.
        low: lower end of the interval.
        high: upper end of the interval.
        height: position of the line along y.
        colour: colour of the line.
        width: width of the line in points.
    """
    style: dict[str, Any] = {"color": colour, "lw": width, "zorder": 2}
    panel.plot([low, high], [height, height], solid_capstyle="butt", **style)


@dataclass(frozen=True, kw_only=True)
class Curves:
    """Curves over a swept value, with a panel for each group of lines and measure.

    Args:
        table: one row per point of a line: `panel`, the title of the line's group;
            `line`, the line's name; `x`, the swept value; a column for each measure;
            and, if the measure has an interval, its ends in the columns that end in
            `_low` and `_high`.
        measures: label of each measure, by column.
        looks: style of each line by name, as from `line_looks`.
        x_label: label of the x-axis.
        across: maximum number of groups next to each other.
        high_in: height of a panel in inches.
        width_in: width of the figure in inches, as in `panel_grid`.
        bars: whether intervals are bars instead of bands.
    """

    table: pd.DataFrame
    measures: Mapping[str, str]
    looks: Looks
    x_label: str
    across: int = 4
    high_in: float = 1.65
    width_in: float = 0.0
    bars: bool = False

    def draw(self) -> tuple[Figure, dict[tuple[str, str], Axes]]:
        """Draw the curves.

        If there is a single group, its measures are side by side, with their labels as
        titles. If there are several groups, the measures of a group are stacked.

        Returns:
            The figure, without a legend, and its panels by group and measure.
        """
        groups = list(dict.fromkeys(self.table["panel"]))
        labels = list(self.measures.values())
        is_single = len(groups) == 1 and self.across > 1
        titles = labels if is_single else groups
        layers = 1 if is_single else len(labels)
        high_in = self.high_in * layers
        figure, stacks = panel_grid(
            titles, self.across, high_in, 0.5, self.width_in, layers, sharex=True
        )
        across = min(self.across, len(titles))
        for index, stack in enumerate(stacks):
            stack[-1].set_xlabel(self.x_label)
            stack[-1].tick_params(labelbottom=True)
            if is_single:
                continue
            for panel, first, label in zip(stack, stacks[0], labels, strict=True):
                if index:
                    panel.sharey(first)
                is_leftmost = index % across == 0
                panel.tick_params(labelleft=is_leftmost)
                panel.set_ylabel(label if is_leftmost else "")
        keys = itertools.product(groups, self.measures)
        panels = dict(zip(keys, itertools.chain(*stacks), strict=True))
        for (group, measure), panel in panels.items():
            self._draw_lines(panel, group, measure)
        return figure, panels

    def _draw_lines(self, panel: Axes, group: str, measure: str) -> None:
        rows = self.table[self.table["panel"] == group]
        for line, points in rows.groupby("line", sort=False):
            x = points["x"]
            y = points[measure]
            low = points.get(f"{measure}_low", y)
            high = points.get(f"{measure}_high", y)
            look = self.looks[line]
            draw_estimates(panel, x, y, low, high, look, str(line), self.bars)
        panel.grid(axis="y", color=GRID)


def draw_baseline(
    panel: Axes, value: float, label: str, horizontal: bool = True
) -> None:
    """Draw a reference value as a dashed line.

    Args:
        panel: panel to draw on.
        value: reference value, such as that of a calibrated model.
        label: text of the legend entry.
        horizontal: whether the value belongs to y instead of x.
    """
    draw_line = panel.axhline if horizontal else panel.axvline
    draw_line(value, color="0.4", lw=0.8, ls="--", zorder=1, label=label)


def ticks_of(panel: Axes, axis: Literal["x", "y"], max_intervals: int = 4) -> None:
    """Place ticks of an axis at multiples of 1, 2 or 5 times a power of ten.

    Args:
        panel: panel to which the axis belongs.
        axis: name of the axis.
        max_intervals: maximum number of intervals between ticks.
    """
    panel.locator_params(axis=axis, nbins=max_intervals, steps=[1, 2, 5, 10])


def jitter(count: int, width: float) -> np.ndarray:
    """Return `count` fixed pseudo-random offsets, uniform in [−width, width]."""
    return np.random.default_rng(0).uniform(-width, width, count)
