"""Tests of the hypotheses that a suite fixed, map by map.

A difference is tested by flipping signs; non-inferiority, superiority and equivalence by a margin by where the interval
of the difference ends (two one-sided tests). Holm's correction is over the whole list.
Sources: Schuirmann (1987), "A comparison of the two one-sided tests procedure and the power approach for assessing the
equivalence of average bioavailability"; Wellek (2010), "Testing Statistical Hypotheses of Equivalence and
Noninferiority", 1.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import brentq

from benchnav.core.quantity import Quantity
from benchnav.core.resampling import holm, sign_flips
from benchnav.eval.experiment.hypotheses import Hypothesis
from benchnav.eval.stats.comparison import (
    ALPHA,
    gain_by_map,
    mean_differences,
    summed_differences,
    time_difference,
)
from benchnav.eval.stats.paired_difference import mean_interval, sign_flip_p, success_interval
from benchnav.eval.stats.pairs import side_by_side
from benchnav.eval.stats.summary import time_budgets
from benchnav.metrics.shipped import QUANTITIES, SUCCESS, TOTAL_TIME

# Confidence at which a p-value of a margin is looked for, but for what rounds to 0 and 1.
_MOST = 1 - 1e-12


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
        is_whole: the run is finished. Of a part of it differences and intervals are computed on common episodes, and
            `p`, `p_holm` are NaN: a test is made once.
        quantities: what conditions are compared by, by name.

    Returns:
        A row a hypothesis, of which `difference` is of `one` less `other`: all fields of `Hypothesis` and `claim`;
        `unit` of all that follows; `n_maps`, of which a group counts as one, and `n_episodes` of each condition;
        `mean_one`, `mean_other`, `difference`, and the ends of its 95 % and 90 % intervals, `low`, `high`, `low_90`,
        `high_90`; `p`, after Holm's correction `p_holm`; and `supported`, true where `p_holm` is under 0.05. Under
        `core.resampling.LEAST_MAPS` maps a difference of anything but success has no interval.
    """
    rows = dict(list(episodes.groupby("condition", sort=False)))
    made = []
    for plain in about["tests"]:
        test = Hypothesis(**{name: value for name, value in plain.items() if name not in ("names", "claim")})
        one, other = (
            own.assign(time_budget_s=time_budgets(own, worlds[condition]))
            for condition in (test.one, test.other)
            for own in [rows.get(condition, episodes.iloc[:0])]
        )
        quantity = quantities[test.metric]
        both = comparable(one, other, quantity)
        p = p_of(test, both, quantities) if is_whole else np.nan
        made.append({**plain, **describe_pair(quantity, both), "p": p})
    table = pd.DataFrame(made)
    table["p_holm"] = holm(table["p"].to_numpy()) if is_whole else np.nan
    return table.assign(supported=table["p_holm"] < ALPHA)


def comparable(one: pd.DataFrame, other: pd.DataFrame, quantity: Quantity) -> pd.DataFrame:
    """Return the episodes in which two conditions can be compared by a quantity, side by side.

    Args:
        one: rows of a condition, with T of each as `time_budget_s`.
        other: rows of the other, as well.
        quantity: what is compared.

    Returns:
        The episodes of which both have a value and, for a quantity `of_arrivals`, in which both reached the goal; see
        `side_by_side`.
    """
    column = quantity.column
    measures = dict.fromkeys(["success", "total_time_s", "time_budget_s", column])
    both = side_by_side(one, other, [*measures])
    if quantity.of_arrivals:
        both = both[both["success"] & both["success_other"]]
    return both.dropna(subset=[column, f"{column}_other"])


def describe_pair(quantity: Quantity, rows: pd.DataFrame) -> dict[str, Any]:
    """Return `unit`, counts, means and the difference with its 95 % and 90 % intervals; see `test_hypotheses`.

    Args:
        quantity: what is compared.
        rows: from `comparable`.
    """
    row: dict[str, Any] = {
        "unit": quantity.unit,
        "n_maps": rows["group"].nunique(),
        "n_episodes": len(rows),
        "mean_one": quantity.scale * rows[quantity.column].mean(),
        "mean_other": quantity.scale * rows[f"{quantity.column}_other"].mean(),
    }
    for suffix, confidence in (("_90", 0.9), ("", 0.95)):
        difference, low, high = _interval(rows, quantity, confidence)
        row |= {"difference": difference, f"low{suffix}": low, f"high{suffix}": high}
    return row


def _interval(rows: pd.DataFrame, quantity: Quantity, confidence: float) -> tuple[float, float, float]:
    """Difference in the quantity's unit, with its interval; NaN where there are too few maps."""
    if quantity.name == TOTAL_TIME.name and len(rows):
        return time_difference(rows, confidence)
    if quantity.name == SUCCESS.name:
        gain, draws = gain_by_map(rows)
        if len(gain) < 2:
            return float(100 * gain.sum() / max(len(rows), 1)), np.nan, np.nan
        found = success_interval(gain, draws, confidence)
    else:
        found = mean_interval(mean_differences(rows, quantity.column), confidence)
    difference, low, high = (quantity.scale * float(value) for value in found)
    return difference, low, high


def p_of(test: Hypothesis, rows: pd.DataFrame, quantities: Mapping[str, Quantity] = QUANTITIES) -> float:
    """p of a hypothesis before any correction; 1 where there are too few maps to tell.

    Args:
        test: what is claimed.
        rows: episodes of the two conditions side by side, the other's columns ending in `_other`.
        quantities: what conditions are compared by, by name.
    """
    quantity = quantities[test.metric]
    if test.kind == "difference":
        return difference_p(quantity, rows, test.direction)
    sides = {"higher": (-1.0,), "lower": (1.0,)}.get(test.direction, (-1.0, 1.0))
    margin = -test.margin if test.kind == "superiority" else test.margin
    return max(_margin_p(quantity, rows, margin, side) for side in sides)


def difference_p(quantity: Quantity, rows: pd.DataFrame, direction: str = "") -> float:
    """p of no difference, by flipping signs map by map; 1 without episodes.

    Args:
        quantity: what is compared.
        rows: from `comparable`.
        direction: in which the one is thought to lie, `higher` or `lower`; two-sided if empty.
    """
    if not len(rows):
        return 1.0
    if quantity.name == SUCCESS.name:
        return sign_flip_p(gain_by_map(rows)[0].astype(int), direction)
    sums = summed_differences(rows, quantity.column)
    # Sizes in one order, so that neither the order of maps nor one without a difference matters.
    sizes = np.sort(np.abs(sums[sums != 0]))[::-1]
    flipped, seen = sign_flips(len(sizes)) @ sizes, sums.sum()
    if direction == "lower":
        seen = -seen
    elif not direction:
        flipped, seen = np.abs(flipped), abs(seen)
    # Sums are exact to rounding, and ways that tie with what was seen count.
    return float(np.mean(flipped >= seen - 1e-9 * sizes.sum()))


def _margin_p(quantity: Quantity, rows: pd.DataFrame, margin: float, side: float) -> float:
    """p that the difference is beyond a margin, below −margin (side −1) or above it (side 1).

    It is the level at which the end of the one-sided interval comes to lie on the margin.
    """

    def end(signed: float) -> float:
        """Of the confidence the end on the margin's side; of a negative one the other end."""
        _, low, high = _interval(rows, quantity, abs(signed))
        return side * (high if (side > 0) == (signed >= 0) else low)

    if np.isnan(end(0.5)):
        return 1.0
    if end(_MOST) < margin:
        return (1 - _MOST) / 2
    if end(-_MOST) > margin:
        return 1.0
    signed = brentq(lambda confidence: end(confidence) - margin, -_MOST, _MOST)
    return (1 - float(signed)) / 2
