"""Panels of numbers: grids of panels, curves over a swept value, and rows of estimates with their intervals."""

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
        dashed: whether lines differ in their dashes, else in their markers, beside their colours.
    """
    looks = {}
    for place, name in enumerate(dict.fromkeys(names)):
        turn, rest = divmod(place, len(LINE_COLOURS))
        colour = colours[place] if colours else LINE_COLOURS[rest]
        marked = {"marker": MARKERS[place % len(MARKERS)], "ms": 3.5, "ls": line_style(turn)}
        looks[name] = {"color": colour, "lw": 1.1, **({"ls": line_style(place)} if dashed else marked)}
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
        width_in: width of the figure; 0 for a column of a page for one place across, and else both columns.
        layers: panels of a place, stacked.
        **shared: as in `Figure.subplots`.

    Returns:
        The figure, and the panels of each place, downward.
    """
    across = max(1, min(across, len(titles)))
    width = width_in or (ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN)
    figure = Figure(figsize=(width, high_in * -(-len(titles) // across) + rest_in), layout="constrained")
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
    """Draw an interval as a horizontal line, `width` points thick, at a height of a panel."""
    panel.plot([low, high], [height, height], color=colour, lw=width, solid_capstyle="butt", zorder=2)


@dataclass(frozen=True, kw_only=True)
class Curves:
    """Curves over a swept value, a panel for each group of lines and measure.

    Args:
        table: a row a point: `panel`, the title of its group; `line`, its name; `x`; of each measure its column, and
            where it has an interval those that end in `_low` and `_high`.
        measures: by column its label.
        looks: by line.
        x_label: of the axis.
        across: groups side by side, at most.
        high_in: height of a panel in inches.
        width_in: of the figure, as in `panel_grid`.
        bars: whether intervals are bars in place of bands.
        as_titles: whether labels of measures stand over their panels; these must then be of one group.
    """

    table: pd.DataFrame
    measures: Mapping[str, str]
    looks: Looks
    x_label: str
    across: int = 4
    high_in: float = 1.65
    width_in: float = 0.0
    bars: bool = False
    as_titles: bool = False

    def draw(self) -> tuple[Figure, dict[tuple[str, str], Axes]]:
        """Draw them.

        Returns:
            The figure, without a legend, and its panels by group and measure.
        """
        groups = list(dict.fromkeys(self.table["panel"]))
        if len(groups) == 1 and (self.as_titles or self.across > 1):
            panels = self._side_by_side(groups[0])
        else:
            panels = self._stacked(groups)
        for (group, measure), panel in panels.items():
            own = self.table[self.table["panel"] == group]
            for line, points in own.groupby("line", sort=False):
                x, y = points["x"], points[measure]
                low, high = (points.get(f"{measure}_{end}", y) for end in ("low", "high"))
                draw_estimates(panel, x, y, low, high, self.looks[line], str(line), self.bars)
            panel.grid(axis="y", color=GRID)
        figure = next(iter(panels.values())).get_figure()
        assert isinstance(figure, Figure)
        return figure, panels

    def _side_by_side(self, group: str) -> dict[tuple[str, str], Axes]:
        labels = list(self.measures.values())
        titles = labels if self.as_titles else [group] * len(labels)
        width = self.width_in or TWO_COLUMNS_IN
        _, places = panel_grid(titles, self.across, self.high_in, width_in=width, sharex=True)
        for (panel,), label in zip(places, labels, strict=True):
            panel.set_ylabel("" if self.as_titles else label)
        figure = places[0][0].get_figure()
        assert isinstance(figure, Figure)
        figure.supxlabel(self.x_label)
        return {(group, name): panel for name, (panel,) in zip(self.measures, places, strict=True)}

    def _stacked(self, groups: Sequence[str]) -> dict[tuple[str, str], Axes]:
        layers = len(self.measures)
        _, places = panel_grid(
            groups, self.across, self.high_in * layers, width_in=self.width_in, layers=layers, sharex=True
        )
        across = min(self.across, len(groups))
        for place, stack in enumerate(places):
            for panel, first, label in zip(stack, places[0], self.measures.values(), strict=True):
                if place:
                    panel.sharey(first)
                panel.tick_params(labelleft=place % across == 0)
                panel.set_ylabel("" if place % across else label)
            stack[-1].set_xlabel(self.x_label)
            stack[-1].tick_params(labelbottom=True)
        panels: dict[tuple[str, str], Axes] = {}
        for group, stack in zip(groups, places, strict=True):
            panels |= {(group, name): panel for name, panel in zip(self.measures, stack, strict=True)}
        return panels


def draw_baseline(panel: Axes, value: float, label: str, horizontal: bool = True) -> None:
    """Draw the value of a calibrated model, or another that all else is seen against, as a dashed line."""
    line = panel.axhline if horizontal else panel.axvline
    line(value, color="0.4", lw=0.8, ls="--", zorder=1, label=label)


def ticks_of(panel: Axes, axis: Literal["x", "y"], most: int = 4) -> None:
    """Limit the intervals between the ticks of an axis, which are at 1, 2 and 5 times powers of ten."""
    panel.locator_params(axis=axis, nbins=most, steps=[1, 2, 5, 10])


def jitter(count: int, width: float) -> np.ndarray:
    """Return the same offsets for a count at each call, uniform within a width to either side."""
    return np.random.default_rng(0).uniform(-width, width, count)
