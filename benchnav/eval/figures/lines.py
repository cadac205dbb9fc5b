"""Division of curves into panels with as many lines as a reader can distinguish."""

from collections.abc import Sequence

import pandas as pd

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.words import joined, reading_name

MAX_ACROSS = 4  # panels side by side
_MAX_LINES = 7  # of a panel
# Labels that a blind planner does not depend on.
_BLIND_TO = ("model", "sensor", "ground", "belief", "who", "planner", "risk")


def divide_lines(
    labels: pd.DataFrame, alternatives: Sequence[Sequence[str]]
) -> tuple[list[str], list[tuple[str, list[int]]]]:
    """Divide lines into panels by the first alternative that leaves few enough in each.

    A blind planner is repeated in all panels of its scenario that have other lines.

    Args:
        labels: one row per line, indexed from 0, and one column per kind of label.
        alternatives: columns that panels differ in.

    Returns:
        The columns in the panels' titles, and title and lines of each panel.
    """
    is_blind = labels["model"] == NOT_USED
    numbered = labels.assign(line=labels.index)
    for columns in alternatives:
        seeing = numbered.loc[~is_blind, [*columns, "line"]]
        settings = seeing[list(columns)].drop_duplicates()
        fixed_columns = [name for name in columns if name not in _BLIND_TO]
        blind = numbered.loc[is_blind, [*fixed_columns, "line"]]
        blind = blind.merge(settings, "left", fixed_columns).fillna(NOT_USED)
        shown = pd.concat([seeing, blind])
        by_panel = shown.groupby(list(columns), sort=False)["line"]
        groups = by_panel.agg(list).reset_index()
        if groups["line"].map(len).max() <= _MAX_LINES:
            break
    titled = [name for name in columns if groups[name].nunique() > 1]
    panels = []
    for row in groups.to_dict("records"):
        title = joined(reading_name(name, row[name]) for name in titled)
        panels.append((title, row["line"]))
    return titled, panels
