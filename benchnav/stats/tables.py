"""Tables of comparisons: columns that write their own cells, and how numbers are
written.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchnav.core.tables import NOTHING, Table

Row = Mapping[Any, Any]


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Args:
        heading: over it; a line break within it is kept in a terminal only.
        cell: the text of a row.
        meaning: what the column holds, under the table; not explained if empty.
        title: before the meaning, if that is of several columns; the heading if empty.
    """

    heading: str
    cell: Callable[[Row], str]
    meaning: str = ""
    title: str = ""


def table_of(rows: Iterable[Row], columns: Sequence[Column], **options: Any) -> Table:
    """Write rows as a table.

    Args:
        rows: values by name.
        columns: those of labels first.
        options: other fields of `Table`.
    """
    return Table(
        headings=tuple(column.heading for column in columns),
        rows=tuple(tuple(column.cell(row) for column in columns) for row in rows),
        explained=tuple(
            (column.title or " ".join(column.heading.split()), column.meaning)
            for column in columns
            if column.meaning
        ),
        **options,
    )


def labels_of(*names: str) -> list[Column]:
    """Return columns that show values as they are, under their names."""
    return [Column(name, cell_of(name)) for name in names]


def cell_of(name: str, write: Callable[[Any], str] = str) -> Callable[[Row], str]:
    """Return what writes one value of a row.

    Args:
        name: of the value.
        write: writes it.
    """
    return lambda row: write(row[name])


def p_value(p: float) -> str:
    """Write a p-value; of drawn sign flips the minimum is 0.0001."""
    return "≤ 0.0001" if p <= 1e-4 else f"{p:.2g}"


def short(value: float) -> str:
    """Write a number with one decimal place, unless that is 0."""
    return f"{value:.1f}".removesuffix(".0")


def signed(value: float, digits: int = 1) -> str:
    """Write a difference with its sign; a dash for NaN."""
    # No minus before a zero.
    return NOTHING if np.isnan(value) else f"{round(value, digits) + 0.0:+.{digits}f}"


def signed_interval(low: float, high: float, digits: int = 1) -> str:
    """Write the ends of an interval of a difference; a dash for NaN."""
    return (
        NOTHING if np.isnan(low) else f"{signed(low, digits)} to {signed(high, digits)}"
    )
