"""Curves with intervals over rows of summaries, for the figures of the studies."""

from collections.abc import Mapping
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchnav.viz import Curves, legend_outside, line_looks

# Columns of a summary (value, lower and upper end), factor to the label's unit, label.
SUCCESS = ("success_rate", "success_low", "success_high"), 100.0, "success [%]"
TOTAL_TIME = (
    ("total_time_mean_s", "total_time_low_s", "total_time_high_s"),
    1.0,
    "T_total [s]",
)


def in_units(row: Any, measure: Any) -> list[Any]:
    """Return a measure and the ends of its interval, in the unit of its label."""
    columns, factor, _ = measure
    return [factor * row[column] for column in columns]


def draw_curves(
    rows: pd.DataFrame,
    measures: Mapping[str, Any],
    x_label: str = "",
    across: int = 2,
    high_in: float = 2.0,
) -> tuple[Figure, dict[tuple[str, str], Axes]]:
    """Draw measures of conditions as markers with 95 % intervals, and a legend.

    Args:
        rows: rows of a summary with the columns `panel`, `line` and `x`; a curve joins
            the rows of one line in their order.
        measures: measures such as `SUCCESS`, by name.
        x_label: label of the x axes.
        across: number of panels next to each other.
        high_in: height of a panel in inches.

    Returns:
        The figure, and its axes by (`panel`, measure).
    """
    table, labels = rows.copy(), {}
    for name, measure in measures.items():
        labels[name] = measure[-1]
        for end, values in zip(
            ("", "_low", "_high"), in_units(table, measure), strict=True
        ):
            table[name + end] = values
    looks = line_looks(list(rows["line"]))
    curves = Curves(
        table=table,
        measures=labels,
        looks=looks,
        x_label=x_label,
        across=across,
        high_in=high_in,
        bars=True,
    )
    figure, panels = curves.draw()
    legend_outside(figure, columns=min(len(looks), 4), side="upper center")
    return figure, panels
