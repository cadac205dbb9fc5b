import re
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.report.findings import findings
from tests.eval.report import made

NONE = pd.DataFrame({"condition": [], "last_traversability": []})


def condition(count: int, of: int = 100, outcome: str = "immobilised", **labels: str) -> list[dict[str, Any]]:
    """A condition that succeeds on the first maps."""
    own = made.condition(**labels)
    failed = [made.row(own, i, None, outcome=outcome) for i in range(count, of)]
    return [*(made.row(own, i) for i in range(count)), *failed]


def said(*conditions: list[dict[str, Any]], failures: pd.DataFrame = NONE, told: Any = None) -> list[str]:
    (sentences,) = findings(summary_of(*conditions), failures, told or {}).values()
    return sentences


def summary_of(*conditions: list[dict[str, Any]]) -> pd.DataFrame:
    return made.summary(made.rows(*conditions))


def test_a_best_that_all_others_are_worse_than() -> None:
    sentences = said(condition(90, risk="cvar:0.9"), condition(40, risk="mean"), condition(30, risk="var"))
    assert sentences[0] == (
        "The highest success rate is that of MPPI, cvar:0.9: 90 % of its episodes reached the goal (95 % interval "
        "83 to 94 %)."
    )
    assert sentences[1] == "All 2 other settings are significantly worse: it is the best here."
    assert sentences[2].startswith(
        "The next is MPPI, mean with 40 %: the difference is 50.0 points (95 % interval of the pair alone "
    )
    assert sentences[2].endswith(", p ≤ 0.0001 (max-T sign-flip test by map over 3 settings).")
    assert sentences[3] == "MPPI, cvar:0.9 failed in 10 of 100 episodes: 10 immobilised (100 %)."
    assert sentences[4] == (
        "All 3 compared settings together failed in 140 of 300 episodes: 140 immobilised (100 %)."
    )
    assert len(sentences) == 5


def test_one_that_is_not_worse_and_the_next_that_is() -> None:
    sentences = said(condition(40, risk="mean"), condition(88, risk="var"), condition(90, risk="cvar"))
    assert sentences[1] == "1 other setting is not significantly worse (p ≥ 0.05): MPPI, var."
    assert sentences[2].startswith(
        "The next that is significantly worse is MPPI, mean with 40 %: the difference is 50.0 points"
    )


def test_several_that_are_not_worse_are_named_up_to_six() -> None:
    sentences = said(*(condition(90 - n // 4, risk=f"r{n}") for n in range(9)), condition(5, risk="bad"))
    assert sentences[1] == (
        "8 other settings are not significantly worse (p ≥ 0.05): "
        "MPPI, r1; MPPI, r2; MPPI, r3; MPPI, r4; MPPI, r5; MPPI, r6 and 2 more."
    )


def test_where_nothing_is_worse_the_run_does_not_say_which_is_best() -> None:
    sentences = said(condition(90, risk="a"), condition(89, risk="b"), condition(88, risk="c"))
    assert re.fullmatch(
        r"No setting is significantly worse \(max-T sign-flip test by map over 3 settings, p ≥ 0\.\d+; 100 maps detect "
        r"differences of \d points or more with 80 % power\): the run does not say which is best\.",
        sentences[1],
    )
    assert not any("The next" in line for line in sentences)


def test_the_interval_is_that_of_the_difference_and_the_power_that_of_the_hardest_pair() -> None:
    summary = summary_of(condition(40, risk="mean"), condition(90, risk="cvar"))
    row = summary[summary["risk"] == "mean"].iloc[0]
    low, high = 100 * row["best_low"], 100 * row["best_high"]
    told = findings(summary, NONE, {})["std"][2]
    assert f"(95 % interval of the pair alone {low:.1f} to {high:.1f})" in told
    alike = summary_of(condition(90, risk="a"), condition(89, risk="b"), [*condition(87, risk="c")])
    shown = 100 * alike["best_shown"].max()
    assert alike["best_shown"].min() < alike["best_shown"].max()
    assert f"differences of {shown:.0f} points or more" in findings(alike, NONE, {})["std"][1]


def test_settings_that_were_run_on_unlike_maps_are_said_to_be_compared_on_those_they_share() -> None:
    sentences = said(condition(90, risk="a"), condition(10, of=40, risk="b"))
    assert sentences[1] == "The settings are compared on the 40 episodes that all of them have."
    assert not any("compared on" in line for line in said(condition(90, risk="a"), condition(10, risk="b")))


def test_a_rate_is_not_rounded_to_all() -> None:
    assert "99.6 % of its episodes" in said(condition(249, of=250))[0]


def test_a_single_setting_and_two() -> None:
    alone = said(condition(100))
    assert alone[1:] == ["There is no other setting to compare it with.", "MPPI, cvar never failed."]
    two = said(condition(90, risk="a"), condition(10, risk="b"))
    assert two[1] == "The other setting is significantly worse: it is the best here."
    assert two[2].endswith("(max-T sign-flip test by map over 2 settings).")


def test_failures_are_counted_by_outcome_the_most_frequent_first() -> None:
    rows = condition(90, of=96, outcome="stuck")
    own = made.condition()
    rows += [made.row(own, i, None, outcome="out_of_bounds") for i in (96, 97)]
    assert said(rows)[2] == "MPPI, cvar failed in 8 of 98 episodes: 6 stuck (75 %), 2 out of bounds (25 %)."
    many = [made.row(own, i, None, outcome="stuck") for i in range(98, 500)]
    assert said([*rows, *many])[2].endswith("408 stuck (100 %), 2 out of bounds (< 1 %).")


def test_the_ground_of_failures_is_that_of_the_best_alone() -> None:
    best, other = condition(60, risk="a"), condition(50, risk="b")
    failures = pd.DataFrame(
        {
            "condition": [best[0]["condition"]] * 3 + [other[0]["condition"]] * 3,
            "last_traversability": [0.02, 0.04, 0.3, 0.7, 0.8, 0.9],
        }
    )
    without = said(best, other, failures=failures)
    assert "In their last 2 s the robot observed λ = 0.04 (median)." in without
    told = {best[0]["condition"]: np.array([0.5, np.nan, 0.6, 0.9]), other[0]["condition"]: np.array([0.1])}
    assert (
        "At the place where they ended, the predicted λ̂ was 0.60, and in the last 2 s the robot observed λ = 0.04 "
        "(medians)."
    ) in said(best, other, failures=failures, told=told)


def test_what_is_privileged_models_is_set_beside_it() -> None:
    sentences = said(
        condition(50, planner="astar_dwa"), condition(70, planner="astar_dwa", model="oracle", risk="mean"),
        condition(80, planner="astar_dwa", model="oracle"),
        condition(99, planner="astar_dwa", model="clairvoyant", risk="–"),
    )  # fmt: skip
    assert sentences[0].startswith("The highest success rate is that of A* + DWA, paper-v1, cvar: 50 %")
    assert sentences[1] == "There is no other setting to compare it with."
    assert sentences[-2:] == [
        "With the privileged model oracle A* + DWA, oracle, cvar reached 80 %.",
        "With the privileged model clairvoyant A* + DWA, clairvoyant reached 99 %.",
    ]


def test_each_block_has_its_own_finding() -> None:
    summary = summary_of(
        *(condition(n, scenario=s, world=w) for n, s, w in ((90, "std", "a"), (20, "hg", "b")))
    )
    found = findings(summary, NONE, {})
    assert list(found) == ["std, a", "hg, b"]
    assert "90 %" in found["std, a"][0]
    assert "20 %" in found["hg, b"][0]
