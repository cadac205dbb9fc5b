"""Lines of curves, which are divided into panels until none holds more lines than a
reader can distinguish.
"""

from collections.abc import Sequence

import pandas as pd

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.words import joined, reading_name

MAX_ACROSS = 4  # panels side by side
_MAX_LINES = 7  # of a panel
_BLIND_TO = ("model", "sensor", "ground", "belief", "who", "planner", "risk")


def divide_lines(
    labels: pd.DataFrame, ways: Sequence[Sequence[str]]
) -> tuple[list[str], list[tuple[str, list[int]]]]:
    """Divide lines into panels by their labels, the first way if its panels hold few
    enough, else the next.

    A blind planner stands in all panels of its place that have other lines.

    Args:
        labels: a row a line, numbered from 0, a column a kind of label.
        ways: columns that panels differ in.

    Returns:
        The columns that panels are named by; of each panel its title and its lines.
    """
    is_blind = labels["model"] == NOT_USED
    numbered = labels.assign(line=labels.index)
    for columns in ways:
        places = [name for name in columns if name not in _BLIND_TO]
        panels = numbered.loc[~is_blind, list(columns)].drop_duplicates()
        blind = numbered.loc[is_blind, [*places, "line"]].merge(panels, "left", places)
        blind = blind.fillna(NOT_USED)
        shown = pd.concat([numbered.loc[~is_blind, [*columns, "line"]], blind])
        groups = (
            shown.groupby(list(columns), sort=False)["line"].agg(list).reset_index()
        )
        if groups["line"].map(len).max() <= _MAX_LINES:
            break
    titled = [name for name in columns if groups[name].nunique() > 1]
    rows = groups.to_dict("records")
    return titled, [
        (joined(reading_name(name, row[name]) for name in titled), row["line"])
        for row in rows
    ]
