"""Power of the hypotheses of a study, from estimates on its development maps."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import yaml
from scipy.stats import norm

from benchnav.core.tables import NOTHING, to_markdown
from benchnav.eval import read_report
from studies.runs import developed, table_of
from studies.study import Study, Work

ALPHA, POWER = 0.05, 0.8


def power(study: Study, work: Work) -> str:
    """Return a table of the power of each hypothesis, as Markdown.

    The power is given at the first and the last step of Holm's correction, assuming
    that the true difference is the estimate on the development maps. For equivalence
    and non-inferiority it is also given assuming no difference. For tests of a
    difference the table has the smallest difference that the first step detects with a
    power of 0.8.
    """
    maps = yaml.safe_load(study.suite_of("primary").read_text())["maps"]
    tests = read_report(developed(study, work)).tests.to_dict("records")
    rows = [
        {"": number, **_row(test, len(tests), maps)}
        for number, test in enumerate(tests, 1)
    ]
    return to_markdown(table_of(pd.DataFrame(rows)))


def _row(test: Mapping[Any, Any], n_tests: int, maps: int) -> dict[str, str]:
    """Return the cells of one of `n_tests` hypotheses, tested on `maps` maps."""
    half_width = (test["high"] - test["low"]) / 2
    error = half_width / norm.ppf(0.975) * np.sqrt(test["n_maps"] / maps)
    # Levels of the first and the last step of Holm's correction.
    levels = (ALPHA / n_tests, ALPHA)

    def powers(difference: float) -> str:
        values = (power_of(test, error, alpha, difference) for alpha in levels)
        return " to ".join(f"{value:.2f}" for value in values)

    low, high = test["low"], test["high"]
    if_none, detectable = NOTHING, NOTHING
    if test["kind"] in ("equivalence", "non-inferiority"):
        if_none = powers(0.0)
    if test["kind"] == "difference":
        tails = 1 if test["direction"] else 2
        smallest = error * (norm.ppf(1 - levels[0] / tails) + norm.ppf(POWER))
        detectable = f"{smallest:.1f}"
    return {
        "hypothesis": test["claim"],
        "estimate on development maps (95 %)": f"{test['difference']:+.2f} ({low:+.1f} to {high:+.1f})",
        "power at this difference": powers(test["difference"]),
        "power without a difference": if_none,
        f"smallest detectable difference (power {POWER})": detectable,
    }


def power_of(
    test: Mapping[Any, Any], error: float, alpha: float, difference: float
) -> float:
    """Return the probability that a hypothesis is supported.

    Args:
        test: row of a hypothesis with `kind`, `direction` and `margin`.
        error: standard error of the estimate, which is assumed to be normal.
        alpha: significance level.
        difference: true difference.
    """
    kind, margin = test["kind"], test["margin"]
    min_error = max(error, 1e-9)
    if kind == "equivalence":
        ends = (
            (margin + distance) / min_error - norm.ppf(1 - alpha)
            for distance in (difference, -difference)
        )
        return max(0.0, float(sum(norm.cdf(end) for end in ends)) - 1)
    # A test in both directions can only support the side of the true difference.
    gain, tails = abs(difference), 2
    if test["direction"]:
        gain, tails = difference, 1
        if test["direction"] == "lower":
            gain = -difference
    smallest = -margin if kind == "non-inferiority" else margin
    critical = norm.ppf(1 - alpha / tails)
    return float(norm.cdf((gain - smallest) / min_error - critical))
