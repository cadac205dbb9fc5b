import re
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.report.findings import findings
from tests.eval.report import made

NONE = pd.DataFrame({"condition": [], "last_traversability": []})


def condition(
    count: int, of: int = 100, outcome: str = "immobilised", **labels: str
) -> list[dict[str, Any]]:
    """A condition that succeeds on the first maps."""
    own = made.condition(**labels)
    failed = [made.row(own, i, None, outcome=outcome) for i in range(count, of)]
    return [*(made.row(own, i) for i in range(count)), *failed]


def said(
    *conditions: list[dict[str, Any]], failures: pd.DataFrame = NONE, told: Any = None
) -> list[str]:
    (sentences,) = findings(summary_of(*conditions), failures, told or {}).values()
    return sentences


def summary_of(*conditions: list[dict[str, Any]]) -> pd.DataFrame:
    return made.summary(made.rows(*conditions))


def test_a_best_that_all_others_are_worse_than() -> None:
    sentences = said(
        condition(90, risk="cvar:0.9"),
        condition(40, risk="mean"),
        condition(30, risk="var"),
    )
    assert sentences[0] == (
        "MPPI, CVaR₀.₉ has the highest success rate: 90 % of the episodes reached the goal (95 % interval 83 to 94 %)."
    )
    assert sentences[1] == "Both other settings are significantly worse."
    assert sentences[2].startswith(
        "MPPI, mean is the best of those that are significantly worse: 40 %, 50.0 points less (95 % interval "
    )
    assert sentences[2].endswith(
        ", p = 0.0005 (max-T bootstrap test by map over 3 settings)."
    )
    assert (
        sentences[3]
        == "MPPI, CVaR₀.₉ failed in 10 of 100 episodes: 10 immobilised (100 %)."
    )
    assert sentences[4] == (
        "All 3 compared settings together failed in 140 of 300 episodes: 140 immobilised (100 %)."
    )
    assert len(sentences) == 5


def test_one_that_is_not_worse_and_the_next_that_is() -> None:
    sentences = said(
        condition(40, risk="mean"),
        condition(88, risk="var"),
        condition(90, risk="cvar"),
    )
    assert (
        sentences[1]
        == "1 other setting is not significantly worse (p ≥ 0.05): MPPI, VaR."
    )
    assert sentences[2].startswith(
        "MPPI, mean is significantly worse: 40 %, 50.0 points less (95 % interval "
    )


def test_several_that_are_not_worse_are_named_up_to_six() -> None:
    sentences = said(
        *(condition(90 - n // 4, risk=f"r{n}") for n in range(9)),
        condition(5, risk="bad"),
    )
    assert sentences[1] == (
        "8 other settings are not significantly worse (p ≥ 0.05): "
        "MPPI, r1; MPPI, r2; MPPI, r3; MPPI, r4; MPPI, r5; MPPI, r6 and 2 more."
    )


def test_where_nothing_is_worse_there_is_no_significant_difference() -> None:
    sentences = said(
        condition(90, risk="a"), condition(89, risk="b"), condition(88, risk="c")
    )
    assert re.fullmatch(
        r"There is no significant difference between the settings \(max-T bootstrap test by map over 3 settings, "
        r"p ≥ 0\.\d+; 100 maps detect differences of \d points or more with 80 % power\)\.",
        sentences[1],
    )
    assert not any("significantly worse" in line for line in sentences)


def test_the_interval_is_that_of_the_difference_and_the_power_that_of_the_hardest_pair() -> (
    None
):
    summary = summary_of(condition(40, risk="mean"), condition(90, risk="cvar"))
    row = summary[summary["risk"] == "mean"].iloc[0]
    low, high = 100 * row["best_low"], 100 * row["best_high"]
    told = findings(summary, NONE, {})["std"][2]
    assert f"(95 % interval {low:.1f} to {high:.1f}, of this pair only)" in told
    alike = summary_of(
        condition(90, risk="a"), condition(89, risk="b"), [*condition(87, risk="c")]
    )
    shown = 100 * alike["best_shown"].max()
    assert alike["best_shown"].min() < alike["best_shown"].max()
    assert (
        f"differences of {shown:.0f} points or more"
        in findings(alike, NONE, {})["std"][1]
    )


def test_settings_that_were_run_on_unlike_maps_are_said_to_be_compared_on_those_they_share() -> (
    None
):
    sentences = said(condition(90, risk="a"), condition(10, of=40, risk="b"))
    assert sentences[1] == "The comparison uses the 40 episodes that all settings have."
    assert not any(
        "comparison uses" in line
        for line in said(condition(90, risk="a"), condition(10, risk="b"))
    )


def test_a_rate_is_not_rounded_to_all() -> None:
    assert "99.6 % of the episodes" in said(condition(249, of=250))[0]


def test_a_single_setting_and_two() -> None:
    alone = said(condition(100))
    assert alone[1:] == [
        "There is no other setting to compare it with.",
        "MPPI, CVaR never failed.",
    ]
    two = said(condition(90, risk="a"), condition(10, risk="b"))
    assert two[1] == "The other setting is significantly worse."
    assert two[-1].startswith(
        "Both compared settings together failed in 100 of 200 episodes: "
    )
    assert two[2].endswith("(max-T bootstrap test by map over 2 settings).")


def test_a_setting_that_is_alone_with_its_objective_is_said_to_be_and_how_objectives_are_compared() -> (
    None
):
    def second(*episodes: list[dict[str, Any]]) -> list[str]:
        return next(iter(findings(summary_of(*episodes), NONE, {}).values()))[1:-1]

    alone = "There is no other setting with this {} to compare it with."
    how = "benchnav-eval compare --by {0} compares the {0}s of the run."
    for name in ("objective", "robot"):
        both = second(condition(99), condition(80, **{name: "own"}))
        assert both == [alone.format(name), how.format(name)]
        # Settings that differ in more are paired by nothing.
        assert second(condition(99), condition(80, risk="mean", **{name: "own"})) == [
            alone.format(name)
        ]
    assert second(condition(99), condition(80, world="own")) == [alone.format("world")]
    assert second(condition(99), condition(80, robot="own"), condition(70, objective="own")) == [
        alone.format("robot and objective"), how.format("robot"), how.format("objective"),
    ]  # fmt: skip
    for other in ({"scenario": "hg"}, {"robot": "own", "objective": "own"}):
        assert second(condition(99), condition(80, **other)) == [
            "There is no other setting to compare it with."
        ]


def test_failures_are_counted_by_outcome_the_most_frequent_first() -> None:
    rows = condition(90, of=96, outcome="stuck")
    own = made.condition()
    rows += [made.row(own, i, None, outcome="out_of_bounds") for i in (96, 97)]
    assert (
        said(rows)[2]
        == "MPPI, CVaR failed in 8 of 98 episodes: 6 stuck (75 %), 2 out of bounds (25 %)."
    )
    many = [made.row(own, i, None, outcome="stuck") for i in range(98, 500)]
    assert said([*rows, *many])[2].endswith(
        "408 stuck (100 %), 2 out of bounds (< 1 %)."
    )


def test_the_ground_of_failures_is_that_of_the_best_alone() -> None:
    best, other = condition(60, risk="a"), condition(50, risk="b")
    failures = pd.DataFrame(
        {
            "condition": [best[0]["condition"]] * 3 + [other[0]["condition"]] * 3,
            "last_traversability": [0.02, 0.04, 0.3, 0.7, 0.8, 0.9],
        }
    )
    without = said(best, other, failures=failures)
    assert (
        "In the last 2 s of these episodes, the robot observed λ = 0.04 (median)."
        in without
    )
    told = {
        best[0]["condition"]: np.array([0.5, np.nan, 0.6, 0.9]),
        other[0]["condition"]: np.array([0.1]),
    }
    assert (
        "Where these episodes ended, λ̂ was 0.60; in the last 2 s, the robot observed λ = 0.04 (medians)."
    ) in said(best, other, failures=failures, told=told)


def test_privileged_models_are_set_beside_it() -> None:
    sentences = said(
        condition(50, planner="astar_dwa"), condition(70, planner="astar_dwa", model="oracle", risk="mean"),
        condition(80, planner="astar_dwa", model="oracle"),
        condition(99, planner="astar_dwa", model="clairvoyant", risk="–"),
    )  # fmt: skip
    assert sentences[0].startswith(
        "A*+DWA, paper-v1, CVaR has the highest success rate: 50 %"
    )
    assert sentences[1] == "There is no other setting to compare it with."
    assert sentences[-2:] == [
        "For reference, A*+DWA, oracle, CVaR reached 80 % with the privileged model oracle.",
        "For reference, A*+DWA, clairvoyant reached 99 % with the privileged model clairvoyant.",
    ]


def test_each_block_has_its_own_finding() -> None:
    summary = summary_of(
        *(
            condition(n, scenario=s, world=w)
            for n, s, w in ((90, "std", "a"), (20, "hg", "b"))
        )
    )
    found = findings(summary, NONE, {})
    assert list(found) == ["std, a", "hg, b"]
    assert "90 %" in found["std, a"][0]
    assert "20 %" in found["hg, b"][0]
