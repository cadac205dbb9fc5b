"""Curves with intervals, as the figures of the studies show them."""

from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from benchnav.viz.style import LINE_COLOURS, MARKERS

# Columns of a summary with their ends, factor and label.
SUCCESS = (("success_rate", "success_low", "success_high"), 100.0, "success [%]")
TOTAL_TIME = (("total_time_mean_s", "total_time_low_s", "total_time_high_s"), 1.0, "T_total [s]")


def draw_curve(
    panel: Axes,
    x: Any,
    rows: pd.DataFrame,
    place: int,
    label: str = "",
    sizes: Any = None,
    measure: Any = SUCCESS,
) -> Line2D:
    """Draw a measure of conditions with 95 % intervals, a marker each.

    Args:
        panel: where.
        x: of each condition.
        rows: a row of a summary each.
        place: of the curve, by which it has its colour and its marker.
        label: of the curve.
        sizes: area of each marker, in points²; all the same where not given.
        measure: `SUCCESS` or `TOTAL_TIME`.

    Returns:
        A handle for a legend.
    """
    columns, factor, ylabel = measure
    middle, low, high = (factor * rows[column].to_numpy() for column in columns)
    looks: dict[str, Any] = {"color": LINE_COLOURS[place], "marker": MARKERS[place]}
    panel.errorbar(
        x, middle, yerr=[middle - low, high - middle], lw=1.1, elinewidth=0.8, capsize=2, label=label,
        **looks | {"ms": 4.0 if sizes is None else 0.0},
    )  # fmt: skip
    if sizes is not None:
        panel.scatter(x, middle, s=sizes, zorder=3, lw=0, **looks)
    panel.grid(axis="y", color="0.93")
    panel.set_ylabel(ylabel)
    return Line2D([], [], ms=5, lw=1.1, label=label, **looks)
