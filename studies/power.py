"""Power of the hypotheses of a study, by what was found on maps to develop on."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml
from scipy.stats import norm

from benchnav.core.tables import Table, to_markdown
from benchnav.eval.report.write import read_report
from studies.runs import developed
from studies.study import Study, Work

ALPHA, POWER = 0.05, 0.8
_HEADINGS = (
    "", "hypothesis", "found on other maps (95 %)", "power, if so", "power, if no difference",
    f"smallest difference with a power of {POWER}",
)  # fmt: skip


def power(study: Study, work: Work) -> str:
    """Return a table of the power of each hypothesis, as Markdown.

    It is of the first and the last place of Holm's correction, if the difference is the one that was found; of
    equivalence and non-inferiority also if there is none. Of a difference the table has the smallest one that is shown
    with a power of 0.8 in the first place too.
    """
    maps = yaml.safe_load(study.suite_of("primary").read_text())["maps"]
    tests = read_report(developed(study, work)).tests
    rows = tuple(
        _row(number, test, len(tests), maps) for number, test in enumerate(tests.to_dict("records"), 1)
    )
    return to_markdown(Table(headings=_HEADINGS, labels=2, rows=rows))


def _row(number: int, test: Mapping[Any, Any], n_tests: int, maps: int) -> tuple[str, ...]:
    """Return the cells of a hypothesis, one of `n_tests`, on so many maps."""
    error = (test["high"] - test["low"]) / 2 / norm.ppf(0.975) * np.sqrt(test["n_maps"] / maps)
    places = (ALPHA / n_tests, ALPHA)
    if_found, if_none = (
        " to ".join(f"{power_of(test, error, alpha, difference):.2f}" for alpha in places)
        for difference in (test["difference"], 0.0)
    )
    is_margin = test["kind"] in ("equivalence", "non-inferiority")
    tails = 1 if test["direction"] else 2
    smallest = error * (norm.ppf(1 - places[0] / tails) + norm.ppf(POWER))
    found = f"{test['difference']:+.2f} ({test['low']:+.1f} to {test['high']:+.1f})"
    return (
        str(number), test["claim"], found, if_found, if_none if is_margin else "–",
        f"{smallest:.1f}" if test["kind"] == "difference" else "–",
    )  # fmt: skip


def power_of(test: Mapping[Any, Any], error: float, alpha: float, difference: float) -> float:
    """Return the probability that a hypothesis is supported.

    Args:
        test: with `kind`, `direction` and `margin`.
        error: standard error of the estimate, which is normal.
        alpha: level of the test.
        difference: the true one.
    """
    kind, margin = test["kind"], test["margin"]
    if kind == "equivalence":
        ends = (
            (margin + away) / max(error, 1e-9) - norm.ppf(1 - alpha) for away in (difference, -difference)
        )
        return max(0.0, float(sum(norm.cdf(end) for end in ends)) - 1)
    # Of a difference in either direction the side that it lies on counts.
    gain = difference * (-1 if test["direction"] == "lower" else 1) if test["direction"] else abs(difference)
    smallest = -margin if kind == "non-inferiority" else margin
    tails = 1 if test["direction"] else 2
    return float(norm.cdf((gain - smallest) / max(error, 1e-9) - norm.ppf(1 - alpha / tails)))
