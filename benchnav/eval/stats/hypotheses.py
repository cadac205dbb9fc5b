"""Tests of the hypotheses that a suite fixed, per map.

A difference is tested by sign flips, other kinds by a margin
(`benchnav.stats.margins`). Holm's correction is over all hypotheses.
"""

from collections.abc import Mapping
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


def test_hypotheses(
    fixed: Mapping[str, Any],
    episodes: pd.DataFrame,
    worlds: Mapping[str, Mapping[str, Any]],
    is_whole: bool = True,  # noqa: PT028
    quantities: Mapping[str, Quantity] = QUANTITIES,  # noqa: PT028
) -> pd.DataFrame:
    """Test the hypotheses of a run.

    Args:
        fixed: hypotheses from `fix_hypotheses`.
        episodes: all rows of the run.
        worlds: world of each condition, by id.
        is_whole: whether the run is finished. If not, differences and intervals are
            computed on common episodes, and `p`, `p_holm` are NaN: a test is made once.
        quantities: quantities that conditions are compared by, by name.

    Returns:
        A row a hypothesis: all fields of `Hypothesis` and `claim`; `unit` of the
        following columns; `n_maps`, where a group counts as one; `n_episodes` of each
        condition; `mean_one`, `mean_other` and their `difference`, `one` minus `other`,
        with the ends of its 95 % and 90 % intervals, `low`, `high`, `low_90`,
        `high_90`; `p`, and `p_holm` after Holm's correction; and `supported`, true if
        `p_holm` is below 0.05. Below `stats.bootstrap.LEAST_MAPS` maps, a difference of
        any quantity except success has no interval.
    """
    rows = dict(list(episodes.groupby("condition", sort=False)))
    table_rows = []
    for plain in fixed["tests"]:
        skipped = ("names", "claim")
        fields = {name: value for name, value in plain.items() if name not in skipped}
        test = Hypothesis(**fields)
        sides = []
        for condition in (test.one, test.other):
            of_condition = rows.get(condition, episodes.iloc[:0])
            budgets = time_budgets(of_condition, worlds[condition])
            sides.append(of_condition.assign(time_budget_s=budgets))
        quantity = quantities[test.metric]
        paired = comparable(sides[0], sides[1], quantity)
        _, low_90, high_90 = _interval(paired, quantity, 0.9)
        row = {**plain, "unit": quantity.unit}
        row["n_maps"] = paired["group"].nunique()
        row["n_episodes"] = len(paired)
        row |= means_and_difference(quantity, paired)
        row["low_90"] = low_90
        row["high_90"] = high_90
        row["p"] = p_of(test, paired, quantities) if is_whole else np.nan
        table_rows.append(row)
    table = pd.DataFrame(table_rows)
    table["p_holm"] = holm(table["p"].to_numpy()) if is_whole else np.nan
    return table.assign(supported=table["p_holm"] < ALPHA)


def comparable(
    first: pd.DataFrame, second: pd.DataFrame, quantity: Quantity
) -> pd.DataFrame:
    """Return the episodes in which two conditions can be compared, side by side.

    Args:
        first: rows of a condition, with T of each as `time_budget_s`.
        second: rows of the other condition, likewise.
        quantity: the quantity compared.

    Returns:
        The episodes in which both have a value and, for a quantity `of_arrivals`, both
        reached the goal; see `side_by_side`.
    """
    column = quantity.column
    measures = dict.fromkeys(["success", "total_time_s", "time_budget_s", column])
    paired = side_by_side(first, second, [*measures])
    if quantity.of_arrivals:
        paired = paired[paired["success"] & paired["success_other"]]
    return paired.dropna(subset=[column, f"{column}_other"])


def means_and_difference(quantity: Quantity, rows: pd.DataFrame) -> dict[str, float]:
    """Return the means, their difference and its 95 % interval, in the quantity's unit.

    Args:
        quantity: the quantity compared.
        rows: rows from `comparable`.
    """
    difference, low, high = _interval(rows, quantity, 0.95)
    return {
        "mean_one": quantity.scale * rows[quantity.column].mean(),
        "mean_other": quantity.scale * rows[f"{quantity.column}_other"].mean(),
        "difference": difference,
        "low": low,
        "high": high,
    }


def _interval(rows: pd.DataFrame, quantity: Quantity, confidence: float) -> Interval:
    """Return the difference and its interval, NaN if there are too few maps."""
    interval = interval_of(rows, quantity.column, confidence)
    difference, low, high = (quantity.scale * value for value in interval)
    return difference, low, high


def p_of(
    test: Hypothesis,
    rows: pd.DataFrame,
    quantities: Mapping[str, Quantity] = QUANTITIES,
) -> float:
    """Return the uncorrected p of a hypothesis; 1 if there are too few maps.

    Args:
        test: the hypothesis.
        rows: episodes of the two conditions side by side, the other's columns ending in
            `_other`.
        quantities: quantities that conditions are compared by, by name.
    """
    quantity = quantities[test.metric]
    if test.kind == "difference":
        return difference_p(rows, quantity.column, test.direction)
    interval = partial(_interval, rows, quantity)
    return margin_p(interval, test.kind, test.direction, test.margin)
