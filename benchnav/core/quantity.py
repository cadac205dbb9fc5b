"""What a column of numbers holds: its name, its unit, and which way is better; for
tables, tests and figures.
"""

from dataclasses import dataclass
from typing import Literal

Better = Literal["higher", "lower", "neither"]


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A quantity that conditions are compared by.

    Args:
        name: word by which suites and commands name it.
        column: its column in tables of episodes.
        suffix: the unit that ends the column's name, such as `_s`; empty if it has
            none.
        words: what sentences call it.
        unit: unit of differences and margins, and of tables; empty if it has none.
        scale: that unit over the column's, such as 100 for points over a fraction.
        heading: of its column in a report.
        meaning: what one value is, a phrase without its full stop.
        better: which way is better.
        of_arrivals: conditions are compared only over the episodes in which both
            reached the goal.
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
        """The column of a statistic in a summary, such as `total_time_mean_s`."""
        return f"{self.column.removesuffix(self.suffix)}_{statistic}{self.suffix}"
