"""Division of lines into panels with few enough lines to distinguish them."""

from collections.abc import Sequence

import pandas as pd

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.words import display_name, joined

MAX_ACROSS = 4  # panels side by side
_MAX_LINES = 7  # maximum number of lines in a panel
# Columns that do not determine the panels of a blind planner. `who` is the planner in
# the figure `over`.
_BLIND_TO = ("model", "sensor", "ground", "belief", "who", "planner", "risk")


def divide_lines(
    labels: pd.DataFrame, alternatives: Sequence[Sequence[str]]
) -> tuple[list[str], list[tuple[str, list[int]]]]:
    """Divide lines into panels with at most `_MAX_LINES` lines each, if possible.

    The line of a blind planner is repeated in all panels of its scenario.

    Args:
        labels: one row per line, indexed from 0, with one column per kind of label.
        alternatives: lists of columns in which panels differ. The first list with few
            enough lines in each panel is used, otherwise the last list.

    Returns:
        The columns in the titles of panels; and, for each panel, its title and the
        indices of its lines.
    """
    is_blind = labels["model"] == NOT_USED
    numbered = labels.assign(line=labels.index)
    for columns in alternatives:
        predicting = numbered.loc[~is_blind, [*columns, "line"]]
        settings = predicting[list(columns)].drop_duplicates()
        fixed_columns = [name for name in columns if name not in _BLIND_TO]
        blind = numbered.loc[is_blind, [*fixed_columns, "line"]]
        blind = blind.merge(settings, "left", fixed_columns).fillna(NOT_USED)
        shown = pd.concat([predicting, blind])
        by_panel = shown.groupby(list(columns), sort=False)["line"]
        groups = by_panel.agg(list).reset_index()
        if groups["line"].map(len).max() <= _MAX_LINES:
            break
    titled = [name for name in columns if groups[name].nunique() > 1]
    panels = []
    for row in groups.to_dict("records"):
        title = joined(display_name(name, row[name]) for name in titled)
        panels.append((title, row["line"]))
    return titled, panels
