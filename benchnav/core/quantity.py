"""Quantities in tables of episodes: name, unit and better direction."""

from dataclasses import dataclass
from typing import Literal

Better = Literal["higher", "lower", "neither"]


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A quantity that conditions are compared by.

    Args:
        name: identifier in suites and commands.
        column: column in tables of episodes.
        suffix: unit at the end of the column's name, such as `_s`; may be empty.
        words: name in sentences.
        unit: unit of differences, margins and tables; may be empty.
        scale: factor from the column's unit to `unit`, such as 100 from a fraction to
            percentage points.
        heading: heading of the quantity's column in a report.
        meaning: phrase that defines one value, without a full stop.
        better: better direction.
        of_arrivals: whether conditions are compared only over the episodes in which
            both reached the goal.
    """

    name: str
    column: str
    suffix: str = ""
    words: str
    unit: str = ""
    scale: float = 1
    heading: str
    meaning: str
    better: Better = "neither"
    of_arrivals: bool = False

    def summary_column(self, statistic: str) -> str:
        """Return the column of a statistic in a summary, such as `total_time_mean_s`."""
        return f"{self.column.removesuffix(self.suffix)}_{statistic}{self.suffix}"
