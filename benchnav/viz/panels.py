"""Panels of numbers: grids of panels, curves over a swept value, and rows of estimates
with their intervals.
"""

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
GRID = "0.9"  # colour of the lines of a grid


def line_looks(
    names: Sequence[str], colours: Sequence[Any] = (), dashed: bool = False
) -> dict[str, dict[str, Any]]:
    """Return how the line of each name is drawn, as keywords of `Axes.plot`.

    Args:
        names: of the lines; equal names have one look.
        colours: of each name; if empty, those of `LINE_COLOURS` in turn.
        dashed: whether lines differ in their dashes, else in their markers, beside
            their colours.
    """
    looks = {}
    for place, name in enumerate(dict.fromkeys(names)):
        turn, rest = divmod(place, len(LINE_COLOURS))
        colour = colours[place] if colours else LINE_COLOURS[rest]
        marked = {
            "marker": MARKERS[place % len(MARKERS)],
            "ms": 3.5,
            "ls": line_style(turn),
        }
        looks[name] = {
            "color": colour,
            "lw": 1.1,
            **({"ls": line_style(place)} if dashed else marked),
        }
    return looks


def panel_grid(
    titles: Sequence[str],
    across: int,
    high_in: float,
    rest_in: float = 0.5,
    width_in: float = 0.0,
    layers: int = 1,
    **shared: Any,
) -> tuple[Figure, list[list[Axes]]]:
    """Make a figure with a titled place for each of several things, row by row.

    Args:
        titles: of the places.
        across: places side by side, at most.
        high_in: height of a place in inches.
        rest_in: height of what else there is, such as the legend.
        width_in: width of the figure; 0 for a column of a page for one place across,
            and else both columns.
        layers: panels of a place, stacked.
        **shared: as in `Figure.subplots`.

    Returns:
        The figure, and the panels of each place, downward.
    """
    across = max(1, min(across, len(titles)))
    width = width_in or (ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN)
    figure = Figure(
        figsize=(width, high_in * -(-len(titles) // across) + rest_in),
        layout="constrained",
    )
    places = stack_panels(figure, len(titles), across, layers, **shared)
    for (panel, *_), title in zip(places, titles, strict=True):
        panel.set_title(title, parse_math=False)
    return figure, places


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
    """Draw estimates as a line with the band of their intervals.

    Args:
        panel: where.
        x: shape [N].
        y: shape [N].
        low: lower ends of the intervals, shape [N]; NaN for none.
        high: upper ends.
        look: keywords of `Axes.plot`.
        label: of the line in a legend; if empty, none.
        bars: whether intervals are bars in place of a band.
    """
    if bars:
        panel.vlines(x, low, high, color=look["color"], lw=0.7)
    else:
        panel.fill_between(x, low, high, color=look["color"], alpha=0.15, lw=0)
    panel.plot(x, y, label=label or "_line", **look)


def draw_interval(
    panel: Axes, low: float, high: float, height: float, colour: Any, width: float = 1.2
) -> None:
    """Draw an interval as a horizontal line, `width` points thick, at a height of a
    panel.
    """
    panel.plot(
        [low, high],
        [height, height],
        color=colour,
        lw=width,
        solid_capstyle="butt",
        zorder=2,
    )


@dataclass(frozen=True, kw_only=True)
class Curves:
    """Curves over a swept value, a panel for each group of lines and measure.

    Args:
        table: a row a point: `panel`, the title of its group; `line`, its name; `x`; of
            each measure its column, and where it has an interval those that end in
            `_low` and `_high`.
        measures: by column its label.
        looks: by line.
        x_label: of the axis.
        across: groups side by side, at most.
        high_in: height of a panel in inches.
        width_in: of the figure, as in `panel_grid`.
        bars: whether intervals are bars in place of bands.
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
        """Draw them: measures of a single group side by side with their labels as
        titles, else stacked.

        Returns:
            The figure, without a legend, and its panels by group and measure.
        """
        groups, labels = (
            list(dict.fromkeys(self.table["panel"])),
            list(self.measures.values()),
        )
        is_single = len(groups) == 1 and self.across > 1
        titles, layers = (labels, 1) if is_single else (groups, len(labels))
        high_in = self.high_in * layers
        figure, places = panel_grid(
            titles, self.across, high_in, 0.5, self.width_in, layers, sharex=True
        )
        across = min(self.across, len(titles))
        for index, stack in enumerate(places):
            stack[-1].set_xlabel(self.x_label)
            stack[-1].tick_params(labelbottom=True)
            for panel, first, label in zip(
                stack, places[0], () if is_single else labels, strict=not is_single
            ):
                if index:
                    panel.sharey(first)
                panel.tick_params(labelleft=index % across == 0)
                panel.set_ylabel("" if index % across else label)
        keys = [(group, name) for group in groups for name in self.measures]
        panels = dict(
            zip(keys, [panel for stack in places for panel in stack], strict=True)
        )
        for (group, measure), panel in panels.items():
            own = self.table[self.table["panel"] == group]
            for line, points in own.groupby("line", sort=False):
                x, y = points["x"], points[measure]
                low, high = (
                    points.get(f"{measure}_{end}", y) for end in ("low", "high")
                )
                draw_estimates(
                    panel, x, y, low, high, self.looks[line], str(line), self.bars
                )
            panel.grid(axis="y", color=GRID)
        return figure, panels


def draw_baseline(
    panel: Axes, value: float, label: str, horizontal: bool = True
) -> None:
    """Draw the value of a calibrated model, or another that all else is seen against,
    as a dashed line.
    """
    line = panel.axhline if horizontal else panel.axvline
    line(value, color="0.4", lw=0.8, ls="--", zorder=1, label=label)


def ticks_of(panel: Axes, axis: Literal["x", "y"], most: int = 4) -> None:
    """Limit the intervals between the ticks of an axis, which are at 1, 2 and 5 times
    powers of ten.
    """
    panel.locator_params(axis=axis, nbins=most, steps=[1, 2, 5, 10])


def jitter(count: int, width: float) -> np.ndarray:
    """Return the same offsets for a count at each call, uniform within a width to
    either side.
    """
    return np.random.default_rng(0).uniform(-width, width, count)
