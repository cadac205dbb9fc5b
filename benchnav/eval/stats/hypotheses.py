"""Tests of the hypotheses that a suite states in advance; the unit is the map.

A difference is tested by sign flips. Other kinds of hypotheses are tested by intervals
and a margin (`benchnav.stats.margins`). Holm's correction covers all hypotheses of a
run.
"""

from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.eval.experiment.hypotheses import Hypothesis
from benchnav.eval.stats.pairs import side_by_side
from benchnav.eval.stats.summary import time_budgets
from benchnav.metrics.shipped import QUANTITIES
from benchnav.stats.episodes import Interval, difference_p, interval_of
from benchnav.stats.holm import ALPHA, holm
from benchnav.stats.margins import margin_p

_FIELDS = tuple(item.name for item in fields(Hypothesis))


def test_hypotheses(
    fixed: Mapping[str, Any],
    episodes: pd.DataFrame,
    worlds: Mapping[str, Mapping[str, Any]],
    is_whole: bool = True,  # noqa: PT028
    quantities: Mapping[str, Quantity] = QUANTITIES,  # noqa: PT028
) -> pd.DataFrame:
    """Test the hypotheses of a run.

    Args:
        fixed: hypotheses of the run, as returned by `fix_hypotheses`.
        episodes: all rows of the run.
        worlds: world of each condition by id, as in `run.json`.
        is_whole: whether the run is finished. If it is not, `p` and `p_holm` are NaN,
            since a hypothesis must be tested only once.
        quantities: quantities by which conditions are compared, by name.

    Returns:
        One row per hypothesis: all keys of its entry in `tests`; `unit`
        of the following columns; `n_maps`, the number of maps, or of groups of maps;
        `n_episodes` of each condition; `mean_one` and `mean_other`; `difference` (of
        `one` minus `other`), with the limits `low` and `high` of its 95 % interval, and
        `low_90` and `high_90` of its 90 % interval; `p`, and `p_holm` after Holm's
        correction; and `supported`, true if `p_holm` is below 0.05. With fewer than
        `stats.bootstrap.LEAST_MAPS` maps, only a difference in success has an interval.
    """
    rows = dict(list(episodes.groupby("condition", sort=False)))
    table_rows = []
    for entry in fixed["tests"]:
        stated = {field: entry[field] for field in _FIELDS if field in entry}
        test = Hypothesis(**stated)
        sides = []
        for condition in (test.one, test.other):
            side_rows = rows.get(condition, episodes.iloc[:0])
            budgets = time_budgets(side_rows, worlds[condition])
            sides.append(side_rows.assign(time_budget_s=budgets))
        first, second = sides
        quantity = quantities[test.metric]
        paired = comparable(first, second, quantity)
        _, low_90, high_90 = _interval(paired, quantity, 0.9)
        row = {**entry, "unit": quantity.unit}
        row["n_maps"] = paired["group"].nunique()
        row["n_episodes"] = len(paired)
        row |= means_and_difference(quantity, paired)
        row["low_90"] = low_90
        row["high_90"] = high_90
        row["p"] = np.nan
        if is_whole:
            row["p"] = p_of(test, paired, quantities)
        table_rows.append(row)
    table = pd.DataFrame(table_rows)
    table["p_holm"] = np.nan
    if is_whole:
        table["p_holm"] = holm(table["p"].to_numpy())
    return table.assign(supported=table["p_holm"] < ALPHA)


def comparable(
    first: pd.DataFrame, second: pd.DataFrame, quantity: Quantity
) -> pd.DataFrame:
    """Return the episodes in which two conditions can be compared, side by side.

    Args:
        first: rows of the first condition, with the time budget in the column
            `time_budget_s`.
        second: such rows of the second condition.
        quantity: the compared quantity.

    Returns:
        The episodes in which both conditions have a value and, if
        `quantity.of_arrivals`, in which both conditions also reach the goal; columns as
        in `side_by_side`.
    """
    column = quantity.column
    measures = dict.fromkeys(["success", "total_time_s", "time_budget_s", column])
    paired = side_by_side(first, second, [*measures])
    if quantity.of_arrivals:
        both_succeeded = paired["success"] & paired["success_other"]
        paired = paired[both_succeeded]
    return paired.dropna(subset=[column, f"{column}_other"])


def means_and_difference(quantity: Quantity, rows: pd.DataFrame) -> dict[str, float]:
    """Return the two means, and their difference with its 95 % interval.

    The keys are names of columns.

    Args:
        quantity: the compared quantity; the returned values are in its unit.
        rows: rows from `comparable`.
    """
    difference, low, high = _interval(rows, quantity, 0.95)
    first_mean = rows[quantity.column].mean()
    second_mean = rows[f"{quantity.column}_other"].mean()
    return {
        "mean_one": quantity.scale * first_mean,
        "mean_other": quantity.scale * second_mean,
        "difference": difference,
        "low": low,
        "high": high,
    }


def _interval(rows: pd.DataFrame, quantity: Quantity, confidence: float) -> Interval:
    """Return the difference and its interval; NaN limits if there are too few maps."""
    difference, low, high = interval_of(rows, quantity.column, confidence)
    scale = quantity.scale
    return scale * difference, scale * low, scale * high


def p_of(
    test: Hypothesis,
    rows: pd.DataFrame,
    quantities: Mapping[str, Quantity] = QUANTITIES,
) -> float:
    """Return the uncorrected p-value of a hypothesis; 1 if there are too few maps.

    Args:
        test: the hypothesis.
        rows: rows from `comparable`.
        quantities: quantities by which conditions are compared, by name.
    """
    quantity = quantities[test.metric]
    if test.kind == "difference":
        return difference_p(rows, quantity.column, test.direction)
    interval = partial(_interval, rows, quantity)
    return margin_p(interval, test.kind, test.direction, test.margin)
