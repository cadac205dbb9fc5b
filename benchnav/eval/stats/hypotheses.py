"""Tests of the hypotheses that a suite fixed, map by map.

A difference is tested by flipping signs, the others by a margin
(`benchnav.stats.margins`). Holm's correction is over the whole list.
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
    about: Mapping[str, Any],
    episodes: pd.DataFrame,
    worlds: Mapping[str, Mapping[str, Any]],
    is_whole: bool = True,  # noqa: PT028
    quantities: Mapping[str, Quantity] = QUANTITIES,  # noqa: PT028
) -> pd.DataFrame:
    """Tests the hypotheses of a run.

    Args:
        about: from `fix_hypotheses`.
        episodes: all rows of the run.
        worlds: by condition what λ did.
        is_whole: the run is finished. Of a part of it differences and intervals are
            computed on common episodes, and
            `p`, `p_holm` are NaN: a test is made once.
        quantities: what conditions are compared by, by name.

    Returns:
        A row a hypothesis, of which `difference` is of `one` less `other`: all fields
        of `Hypothesis` and `claim`; `unit` of all that follows; `n_maps`, of which a
        group counts as one, and `n_episodes` of each condition; `mean_one`,
        `mean_other`, `difference`, and the ends of its 95 % and 90 % intervals, `low`,
        `high`, `low_90`, `high_90`; `p`, after Holm's correction `p_holm`; and
        `supported`, true where `p_holm` is under 0.05. Under
        `stats.bootstrap.LEAST_MAPS` maps a difference of anything but success has no
        interval.
    """
    rows = dict(list(episodes.groupby("condition", sort=False)))
    made = []
    for plain in about["tests"]:
        test = Hypothesis(
            **{
                name: value
                for name, value in plain.items()
                if name not in ("names", "claim")
            }
        )
        one, other = (
            own.assign(time_budget_s=time_budgets(own, worlds[condition]))
            for condition in (test.one, test.other)
            for own in [rows.get(condition, episodes.iloc[:0])]
        )
        quantity = quantities[test.metric]
        both = comparable(one, other, quantity)
        _, low_90, high_90 = _interval(both, quantity, 0.9)
        made.append(
            {
                **plain,
                "unit": quantity.unit,
                "n_maps": both["group"].nunique(),
                "n_episodes": len(both),
                **means_and_difference(quantity, both),
                "low_90": low_90,
                "high_90": high_90,
                "p": p_of(test, both, quantities) if is_whole else np.nan,
            }
        )
    table = pd.DataFrame(made)
    table["p_holm"] = holm(table["p"].to_numpy()) if is_whole else np.nan
    return table.assign(supported=table["p_holm"] < ALPHA)


def comparable(
    one: pd.DataFrame, other: pd.DataFrame, quantity: Quantity
) -> pd.DataFrame:
    """Return the episodes in which two conditions can be compared by a quantity, side
    by side.

    Args:
        one: rows of a condition, with T of each as `time_budget_s`.
        other: rows of the other, as well.
        quantity: what is compared.

    Returns:
        The episodes of which both have a value and, for a quantity `of_arrivals`, in
        which both reached the goal; see `side_by_side`.
    """
    column = quantity.column
    measures = dict.fromkeys(["success", "total_time_s", "time_budget_s", column])
    both = side_by_side(one, other, [*measures])
    if quantity.of_arrivals:
        both = both[both["success"] & both["success_other"]]
    return both.dropna(subset=[column, f"{column}_other"])


def means_and_difference(quantity: Quantity, rows: pd.DataFrame) -> dict[str, float]:
    """Return `mean_one`, `mean_other` and `difference` with the 95 % interval `low`,
    `high`, in the quantity's unit.

    Args:
        quantity: what is compared.
        rows: from `comparable`.
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
    """Return the difference in the quantity's unit, with its interval; NaN if there are
    too few maps.
    """
    found = interval_of(rows, quantity.column, confidence)
    difference, low, high = (quantity.scale * value for value in found)
    return difference, low, high


def p_of(
    test: Hypothesis,
    rows: pd.DataFrame,
    quantities: Mapping[str, Quantity] = QUANTITIES,
) -> float:
    """Return p of a hypothesis before any correction; 1 if there are too few maps.

    Args:
        test: what is claimed.
        rows: episodes of the two conditions side by side, the other's columns ending in
            `_other`.
        quantities: what conditions are compared by, by name.
    """
    quantity = quantities[test.metric]
    if test.kind == "difference":
        return difference_p(rows, quantity.column, test.direction)
    interval = partial(_interval, rows, quantity)
    return margin_p(interval, test.kind, test.direction, test.margin)
