from copy import deepcopy
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest, ttest_1samp

from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.condition import Condition, conditions_of
from benchnav.eval.experiment.hypotheses import Hypothesis, fix_hypotheses
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent
from benchnav.eval.stats.hypotheses import p_of
from benchnav.eval.stats.hypotheses import test_hypotheses as run_tests
from benchnav.stats.flips import mean_flip_p
from benchnav.stats.intervals import success_interval
from tests.eval.report.made import condition, row, rows

WORLD = {"time_budget_s": 100.0}
MEAN, CVAR = (
    {"planner": "mppi", "risk": "mean"},
    {"planner": "mppi", "risk": "cvar:0.9"},
)


def conditions(**changes: Any) -> dict[str, Condition]:
    given = {
        "planners": ("straight", "mppi"),
        "risks": ("mean", "cvar:0.9"),
        "models": ("oracle",),
    }
    suite = Suite(**{**given, "scenarios": ("std",), **changes})
    return {one.id: one for one in conditions_of(suite, lambda data: ["std", "hg"])}


def fixed(*given: dict[str, Any], **changes: Any) -> dict[str, Any]:
    extent = Extent.product((0,), 1, 20)
    return fix_hypotheses(
        given,
        {i: (condition, extent) for i, condition in conditions(**changes).items()},
    )


def hypothesis(**changes: Any) -> Hypothesis:
    given = {"metric": "success", "kind": "difference", "direction": "", "margin": 0.0}
    return Hypothesis(**{"one": "a", "other": "b", **given, **changes})


def beside(one: np.ndarray, other: np.ndarray, column: str = "score") -> pd.DataFrame:
    """A metric of two conditions, an episode a map."""
    maps = np.arange(len(one))
    return pd.DataFrame(
        {"map": maps, "group": maps, column: one, f"{column}_other": other}
    )


def test_what_neither_side_names_is_paired_value_by_value() -> None:
    about = fixed(
        {"one": CVAR, "other": MEAN, "metric": "success"}, scenarios=("std", "hg")
    )
    assert [test["names"] for test in about["tests"]] == [
        ["std, mppi, cvar:0.9", "std, mppi, mean"], ["hg, mppi, cvar:0.9", "hg, mppi, mean"]
    ]  # fmt: skip
    blind = fixed(
        {
            "one": MEAN,
            "other": {"planner": "straight"},
            "metric": "score",
            "direction": "higher",
        }
    )
    assert [test["claim"] for test in blind["tests"]] == [
        "score of mppi, mean is higher than that of straight"
    ]


def test_a_setting_that_was_merged_names_the_one_row() -> None:
    cost = {"part": "mppi", "label": "cost", "options": {"risk_on": "cost"}}
    merged = {"planners": ("mppi", cost), "world": "stakes"}
    for risk in ("mean", "cvar:0.9", "–"):
        (test,) = fixed(
            {
                "one": {"planner": "cost", "risk": risk},
                "other": MEAN,
                "metric": "success",
            },
            **merged,
        )["tests"]
        assert conditions(**merged)[test["one"]].labels["planner"] == "cost"
        assert test["claim"] == "success of cost differs from that of mppi, mean"
    itself = {
        "one": {"planner": "cost", "risk": "cvar:0.9"},
        "other": {"planner": "cost", "risk": "mean"},
    }
    with pytest.raises(
        ConfigError, match=r"got one: planner 'cost' does not use risk mean, cvar:0\.9"
    ):
        fixed(itself | {"metric": "success"}, **merged)


@pytest.mark.parametrize(
    "change",
    [
        {"metric": "score"},
        {"kind": "non-inferiority", "margin": 5},
        {"direction": "lower"},
        {"one": MEAN, "other": CVAR},
    ],
)
def test_the_digest_is_that_of_all_that_is_claimed(change: dict[str, Any]) -> None:
    given = {"one": CVAR, "other": MEAN, "metric": "success"}
    assert (
        fixed(given)["digest"]
        == fixed(dict(given))["digest"]
        != fixed(given | change)["digest"]
    )
    assert fixed() == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"metric": "sucess"},
            r"Expected `metric` of hypothesis 1 among success, .*Did you mean 'success'\?",
        ),
        (
            {"kind": "equal"},
            "`kind` of hypothesis 1 as 'difference' or 'non-inferiority' or 'superiority' or 'equivalence'",
        ),
        (
            {"direction": "up"},
            "`direction` of hypothesis 1 as '' or 'higher' or 'lower'",
        ),
        (
            {"one": {"planner": "mpi"}},
            r"`planner` of `one` of hypothesis 1 .*Did you mean 'mppi'\?",
        ),
        (
            {"one": {"plannner": "mppi"}},
            r"labels in `one` of hypothesis 1 .*Did you mean 'planner'\?",
        ),
        ({"one": "mppi"}, "name a condition by labels"),
        (
            {"one": {"planner": "mppi", "risk": "cvar"}},
            r"`risk` .*Did you mean 'cvar:0\.9'\?",
        ),
        ({"metrics": "score"}, r"keys of hypothesis 1 .*Did you mean 'metric'\?"),
        ({3: 4}, "keys of hypothesis 1 .*got '3'"),
        ({"margin": 1}, "Leave `margin` out"),
        (
            {"kind": "equivalence"},
            "above 0 and below 100 points for a claim of equivalence, got 0",
        ),
        (
            {"kind": "superiority"},
            "above 0 and below 100 points for a claim of superiority, got 0",
        ),
        (
            {"kind": "superiority", "metric": "end_time", "margin": 1},
            "`direction` in hypothesis 1 .* Neither direction of 'end_time' is better",
        ),
        ({"kind": "equivalence", "margin": -1}, "above 0 .*got -1"),
        ({"kind": "equivalence", "margin": 100}, "below 100 points for .*, got 100"),
        ({"kind": "equivalence", "margin": 1, "direction": "lower"}, "no `direction`"),
        ({"one": MEAN}, "two conditions with the same labels in"),
        (
            {"one": {"planner": "straight"}, "other": {"planner": "mppi"}},
            r"differ in risk .*Name the risk in `other`",
        ),
    ],
)
def test_what_cannot_be_tested_is_refused_at_the_suite(
    change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        fixed({"one": CVAR, "other": MEAN, "metric": "success"} | change)


def test_other_maps_worlds_budgets_and_doubles_are_refused() -> None:
    def named(
        name: str, one: str, other: str, metric: str = "success"
    ) -> dict[str, Any]:
        return {
            "one": CVAR | {name: one},
            "other": CVAR | {name: other},
            "metric": metric,
        }

    with pytest.raises(
        ConfigError,
        match="same maps with the same draws of λ, got two that differ in scenario",
    ):
        fixed(named("scenario", "std", "hg"), scenarios=("std", "hg"))
    with pytest.raises(ConfigError, match="two that differ in world"):
        fixed(named("world", "paper", "stakes"), world=("paper", "stakes"))
    robots = {"robots": ("unicycle", "differential_drive"), "world": "stakes"}
    fixed(named("robot", "unicycle", "differential_drive"), **robots)
    with pytest.raises(ConfigError, match="robots with different T"):
        fixed(named("robot", "unicycle", "differential_drive", "T_total"), **robots)
    same = {"one": CVAR, "other": MEAN, "metric": "success"}
    with pytest.raises(ConfigError, match="got the same one twice"):
        fixed(same, dict(same))


def test_a_margin_is_tested_as_students_test_does() -> None:
    """Two one-sided t-tests by scipy, at each side of the margin."""
    generator = np.random.default_rng(0)
    one, other = generator.normal(0.3, 0.1, (2, 20))
    rows = beside(one, other)
    gain = one - other
    for side, alternative in (("higher", "greater"), ("lower", "less")):
        test = hypothesis(
            metric="score", kind="non-inferiority", direction=side, margin=0.06
        )
        bound = -0.06 if side == "higher" else 0.06
        assert p_of(test, rows) == pytest.approx(
            ttest_1samp(gain, bound, alternative=alternative).pvalue, rel=1e-6
        )
        better = one + 0.12 if side == "higher" else one - 0.12
        test = hypothesis(
            metric="score", kind="superiority", direction=side, margin=0.06
        )
        expected = ttest_1samp(better - other, -bound, alternative=alternative).pvalue
        assert p_of(test, beside(better, other)) == pytest.approx(expected, rel=1e-6)
    both = hypothesis(metric="score", kind="equivalence", margin=0.06)
    expected = max(
        ttest_1samp(gain, -0.06, alternative="greater").pvalue,
        ttest_1samp(gain, 0.06, alternative="less").pvalue,
    )
    assert p_of(both, rows) == pytest.approx(expected, rel=1e-6)
    assert p_of(hypothesis(metric="score", kind="equivalence", margin=1e-6), rows) > 0.5


def test_equivalence_of_success_is_shown_where_the_90_percent_interval_lies_within_the_margin() -> (
    None
):
    gain = np.array([1] * 3 + [-1] * 2 + [0] * 95)
    rows = beside((gain > 0).astype(float), (gain < 0).astype(float), "success")
    _, low, high = success_interval(gain, 1, 0.9)
    edge = 100 * max(-low, high)
    inside, outside = (
        p_of(hypothesis(kind="equivalence", margin=float(margin)), rows)
        for margin in (edge + 0.01, edge - 0.01)
    )
    assert outside > 0.05 > inside


def test_a_difference_is_tested_by_sign_flips_either_way_or_one() -> None:
    gain = np.array([1] * 8 + [-1] * 2 + [0] * 9)
    rows = beside((gain > 0).astype(float), (gain < 0).astype(float), "success")
    for direction, alternative in (
        ("", "two-sided"),
        ("higher", "greater"),
        ("lower", "less"),
    ):
        test = hypothesis(direction=direction)
        assert p_of(test, rows) == pytest.approx(
            binomtest(8, 10, alternative=alternative).pvalue
        )
    values = np.array([0.4, 0.1, -0.2, 0.3, 0.5, 0.6, -0.1, 0.2])
    for direction in ("", "higher", "lower"):
        test = hypothesis(metric="score", direction=direction)
        assert p_of(test, beside(values, 0 * values)) == mean_flip_p(values, direction)


def ran(
    metric: str, one: list[dict[str, Any]], other: list[dict[str, Any]], **changes: Any
) -> pd.Series:
    about = {"tests": [vars(hypothesis(metric=metric, **changes)) | {"claim": "c"}]}
    episodes = rows(
        [r | {"condition": "a"} for r in one], [r | {"condition": "b"} for r in other]
    )
    return run_tests(about, episodes, {"a": WORLD, "b": WORLD}).iloc[0]


def test_each_metric_is_compared_in_its_unit_on_shared_episodes() -> None:
    labels = condition()
    one = [
        row(labels, i, 30.0 + i % 2, traversability=0.8, path_length_m=25.0)
        for i in range(9)
    ]
    one += [
        row(labels, 9, None, traversability=np.nan, path_length_m=3.0),
        row(labels, 77),
    ]
    other = [
        row(labels, i, 35.0, traversability=0.7, path_length_m=22.0) for i in range(10)
    ]
    found = {
        name: ran(name, one, other)
        for name in ("success", "T_total", "traversability", "path_length", "score")
    }
    assert found["success"]["difference"] == pytest.approx(-10)
    assert found["T_total"]["difference"] == pytest.approx(
        (9 * 30 + 4 + 100 - 350) / 10
    )
    assert found["traversability"]["difference"] == pytest.approx(10)
    assert found["path_length"]["difference"] == pytest.approx(3)  # where both arrived
    assert [found[name]["n_maps"] for name in found] == [10, 10, 9, 9, 10]
    assert [found[name]["unit"] for name in found] == ["points", "s", "points", "m", ""]
    assert (
        found["success"]["low"]
        < found["success"]["low_90"]
        < found["success"]["high_90"]
        < found["success"]["high"]
    )
    groups = [[r | {"group": r["map"] // 2} for r in side] for side in (one, other)]
    assert ran("success", *groups)["n_maps"] == 5


def test_holm_is_over_the_list_which_stays_as_it_was_fixed() -> None:
    labels = condition()
    sides = [
        [row(labels, i, 30.0 if i < count else None) for i in range(30)]
        for count in (30, 23)
    ]
    episodes = rows(
        *(
            [r | {"condition": name} for r in side]
            for name, side in zip("ab", sides, strict=True)
        )
    )
    tests = [
        vars(hypothesis(direction=d)) | {"claim": d} for d in ("", "higher", "lower")
    ]
    about = {"tests": tests}
    as_fixed = deepcopy(about)
    table = run_tests(about, episodes, {"a": WORLD, "b": WORLD})
    assert about == as_fixed
    p = 2 / 2**7
    np.testing.assert_allclose(table["p"], [p, p / 2, 1])
    np.testing.assert_allclose(table["p_holm"], [2 * p, 3 * p / 2, 1])
    assert table["supported"].tolist() == [True, True, False]
