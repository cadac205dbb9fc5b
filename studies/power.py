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
    error = (
        (test["high"] - test["low"])
        / 2
        / norm.ppf(0.975)
        * np.sqrt(test["n_maps"] / maps)
    )
    places = (ALPHA / n_tests, ALPHA)
    if_found, if_none = (
        " to ".join(
            f"{power_of(test, error, alpha, difference):.2f}" for alpha in places
        )
        for difference in (test["difference"], 0.0)
    )
    tails = 1 if test["direction"] else 2
    smallest = error * (norm.ppf(1 - places[0] / tails) + norm.ppf(POWER))
    has_margin = test["kind"] in ("equivalence", "non-inferiority")
    return {
        "hypothesis": test["claim"],
        "found on other maps (95 %)": f"{test['difference']:+.2f} ({test['low']:+.1f} "
        f"to {test['high']:+.1f})",
        "power, if so": if_found,
        "power, if no difference": if_none if has_margin else NOTHING,
        f"smallest difference with a power of {POWER}": f"{smallest:.1f}"
        if test["kind"] == "difference"
        else NOTHING,
    }


def power_of(
    test: Mapping[Any, Any], error: float, alpha: float, difference: float
) -> float:
    """Return the probability that a hypothesis is supported.

    Args:
        test: row of a hypothesis with `kind`, `direction` and `margin`.
        error: standard error of the estimate, whose distribution is taken as normal.
        alpha: significance level.
        difference: true difference.
    """
    kind, margin = test["kind"], test["margin"]
    if kind == "equivalence":
        ends = (
            (margin + away) / max(error, 1e-9) - norm.ppf(1 - alpha)
            for away in (difference, -difference)
        )
        return max(0.0, float(sum(norm.cdf(end) for end in ends)) - 1)
    # A test in both directions can only support the side of the true difference.
    gain = (
        difference * (-1 if test["direction"] == "lower" else 1)
        if test["direction"]
        else abs(difference)
    )
    smallest = -margin if kind == "non-inferiority" else margin
    tails = 1 if test["direction"] else 2
    return float(
        norm.cdf((gain - smallest) / max(error, 1e-9) - norm.ppf(1 - alpha / tails))
    )
