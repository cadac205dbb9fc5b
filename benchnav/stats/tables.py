"""Tables of comparisons: columns, and number formats."""

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
        heading: heading of the column; only a terminal shows line breaks in it.
        cell: function from a row to the text of the row's cell.
        meaning: definition of the column, printed below the table; if empty, nothing is
            printed.
        title: text before the meaning, if the meaning covers several columns; if empty,
            the heading.
    """

    heading: str
    cell: Callable[[Row], str]
    meaning: str = ""
    title: str = ""


def table_of(rows: Iterable[Row], columns: Sequence[Column], **options: Any) -> Table:
    """Format rows as a table.

    Args:
        rows: values of each row by name.
        columns: columns of the table, with columns of labels first.
        **options: other fields of `Table`.
    """
    texts = [tuple(column.cell(row) for column in columns) for row in rows]
    explained = []
    for column in columns:
        if column.meaning:
            title = column.title or " ".join(column.heading.split())
            explained.append((title, column.meaning))
    return Table(
        headings=tuple(column.heading for column in columns),
        rows=tuple(texts),
        explained=tuple(explained),
        **options,
    )


def labels_of(*names: str) -> list[Column]:
    """Return columns that show values as text, with the values' names as headings."""
    return [Column(name, cell_of(name)) for name in names]


def cell_of(name: str, write: Callable[[Any], str] = str) -> Callable[[Row], str]:
    """Return a function that formats one value of a row.

    Args:
        name: name of the value.
        write: function from the value to its text.
    """
    return lambda row: write(row[name])


def p_value(p: float) -> str:
    """Format a p-value; the minimum p of random sign flips is 0.0001."""
    return "≤ 0.0001" if p <= 1e-4 else f"{p:.2g}"


def short(value: float) -> str:
    """Format a number with one decimal place, which is omitted if it is 0."""
    return f"{value:.1f}".removesuffix(".0")


def signed(value: float, digits: int = 1) -> str:
    """Format a difference with its sign; a dash for NaN."""
    if np.isnan(value):
        return NOTHING
    rounded = round(value, digits) + 0.0  # turns −0 into 0
    return f"{rounded:+.{digits}f}"


def signed_interval(low: float, high: float, digits: int = 1) -> str:
    """Format the ends of an interval of a difference; a dash for NaN."""
    if np.isnan(low):
        return NOTHING
    return f"{signed(low, digits)} to {signed(high, digits)}"
