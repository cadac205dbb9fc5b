import numpy as np
import pandas as pd
import pytest
from scipy.stats import t

from benchnav.eval.stats.summary import summarise, time_budgets
from benchnav.metrics import Energy
from benchnav.stats.intervals import total_time_interval, wilson_interval
from tests.eval.report import made
from tests.eval.report.made import condition, row, rows


def summary_of(*episodes: dict) -> pd.Series:  # type: ignore[type-arg]
    summary = made.summarised(rows(*episodes))
    assert len(summary) == 1
    return summary.iloc[0]


def test_success_and_times() -> None:
    times = (30.0, 40.0, None, 44.0)
    found = summary_of(
        *(row(condition(), map_index, time) for map_index, time in enumerate(times))
    )
    assert (found["n_episodes"], found["n_maps"]) == (4, 4)
    assert found["success_rate"] == 0.75
    assert (found["success_low"], found["success_high"]) == pytest.approx(
        wilson_interval(0.75, 4)
    )
    assert found["total_time_mean_s"] == pytest.approx((30 + 40 + 100 + 44) / 4)
    assert found["total_time_std_s"] == pytest.approx(np.std([30, 40, 100, 44], ddof=1))
    assert found["success_time_mean_s"] == pytest.approx(38)
    assert found["success_time_std_s"] == pytest.approx(np.std([30, 40, 44], ddof=1))
    assert (found["total_time_n"], found["success_time_n"], found["time_ratio_n"]) == (
        4,
        3,
        3,
    )
    assert found["time_ratio_mean"] == pytest.approx(38 / 25)
    assert found["score_mean"] == pytest.approx(
        (12.5 / 30 + 12.5 / 40 + 0 + 12.5 / 44) / 4
    )


def test_what_an_episode_does_not_have_is_not_averaged() -> None:
    names = ("traversability", "path_length_m", "stuck_share", "roughness_radps2")
    at_once = row(
        condition(), 1, None, outcome="planner_failure", **dict.fromkeys(names, np.nan)
    )
    found = summary_of(
        row(condition(), 0, traversability=0.6),
        at_once,
        row(condition(), 2, traversability=0.8),
    )
    assert found["traversability_mean"] == pytest.approx(0.7)
    assert found["path_length_mean_m"] == 22
    assert found["stuck_share_mean"] == pytest.approx(0.1)
    assert found["roughness_mean_radps2"] == 2
    for name in ("traversability", "path_length", "stuck_share", "roughness"):
        assert found[f"{name}_n"] == 2
    assert found["total_time_n"] == found["score_n"] == found["n_episodes"] == 3


def test_failures_are_counted_by_their_outcome() -> None:
    outcomes = [
        "timeout",
        "stuck",
        "stuck",
        "out_of_bounds",
        "planner_failure",
        "stalled",
        "stalled",
        "stalled",
    ]
    outcomes += ["planner_error", "model_error", "model_error"]
    found = summary_of(
        *(row(condition(), i, None, outcome=o) for i, o in enumerate(outcomes)),
        row(condition(), 99),
    )
    assert {name: found[f"{name}_count"] for name in dict.fromkeys(outcomes)} == {
        "timeout": 1, "stuck": 2, "out_of_bounds": 1, "planner_failure": 1, "stalled": 3, "planner_error": 1,
        "model_error": 2,
    }  # fmt: skip
    assert "success_count" not in found


def test_a_row_a_condition_in_order_of_appearance() -> None:
    order = [
        condition("mppi", scenario="std"),
        condition("cl_rrt", scenario="std"),
        condition("cl_rrt", scenario="hg"),
    ]
    summary = made.summarised(
        rows(*(row(labels, i) for i in range(2) for labels in order))
    )
    assert summary[["planner", "scenario"]].to_numpy().tolist() == [
        ["mppi", "std"], ["cl_rrt", "std"], ["cl_rrt", "hg"]
    ]  # fmt: skip
    assert summary["model"].tolist() == ["paper-v1"] * 3
    assert summary["n_episodes"].tolist() == [2, 2, 2]


def test_time_has_the_interval_of_its_own_condition_over_maps() -> None:
    generator = np.random.default_rng(4)
    taken = {
        name: generator.uniform(20, 60, (12, 3)) + late
        for name, late in (("mppi", 0), ("cl_rrt", 30))
    }
    taken["cl_rrt"][2, 1] = taken["cl_rrt"][7] = 100
    summary = made.summarised(
        rows(
            row(
                condition(name),
                m,
                time if (time := taken[name][m, seed]) < 100 else None,
                seed=seed,
            )
            for seed in range(3)
            for m in range(12)
            for name in taken
        )
    ).set_index("planner")
    for name, times in taken.items():
        found, failed = summary.loc[name], times >= 100
        ends = 1 - found["success_high"], 1 - found["success_low"]
        _, low, high = total_time_interval(
            times.mean(1),
            failed.mean(1),
            ends,
            100 - times[~failed].mean(),
            int((~failed).any(1).sum()),
        )
        assert (found["total_time_low_s"], found["total_time_high_s"]) == pytest.approx(
            (low, min(high, 100))
        )
        assert (
            found["total_time_low_s"]
            < found["total_time_mean_s"]
            < found["total_time_high_s"]
        )


def test_a_time_budget_that_is_a_ratio_is_that_of_each_map() -> None:
    """A robot of 2 m/s: T is three times half of the reference time; failures say it
    themselves.
    """
    reference = np.array([20.0, 30.0, 40.0])
    found = time_budgets(
        rows(
            row(condition(), 0, 12.0, time_ratio=12 / (20 / 2)),
            row(condition(), 1, 30.0, time_ratio=30 / (30 / 2)),
            row(condition(), 2, None, total_time_s=3 * 40 / 2, time_ratio=np.nan),
        ),
        {"time_budget_ratio": 3.0},
    )
    np.testing.assert_allclose(found, 3 * reference / 2)
    assert list(time_budgets(rows(row(condition())), {"time_budget_s": 70.0})) == [70.0]


def test_rare_failures_that_were_not_met_widen_the_interval_by_what_they_would_cost() -> (
    None
):
    arrived = [row(condition(), i, 30.0 + i % 3) for i in range(20)]
    tight, dear = (
        made.summarised(rows(*arrived), {"time_budget_s": budget}).iloc[0]
        for budget in (40.0, 400.0)
    )
    mean = tight["total_time_mean_s"]
    cost = (1 - tight["success_low"]) * np.array([40 - mean, 400 - mean])
    for found, more in zip((tight, dear), cost, strict=True):
        half = mean - found["total_time_low_s"]  # nothing fails less often than never
        assert found["total_time_high_s"] - mean == pytest.approx(np.hypot(half, more))


def test_what_never_arrived_has_an_interval_up_to_its_budget() -> None:
    found = summary_of(*(row(condition(), i, None) for i in range(10)))
    assert found["total_time_high_s"] == 100
    assert found["total_time_low_s"] == pytest.approx(100 * (1 - found["success_high"]))


def test_maps_of_one_group_are_one_unit() -> None:
    """Ten maps of five groups; all maps of a group end alike, so that five is what they
    tell.
    """
    labels = condition()
    alone = [row(labels, i, 30.0 + i // 2 if i >= 2 else None) for i in range(10)]
    grouped = [{**one, "group": one["map"] // 2} for one in alone]
    by_map, by_group = summary_of(*alone), summary_of(*grouped)
    assert (by_map["n_maps"], by_map["n_groups"]) == (10, 10)
    assert (by_group["n_maps"], by_group["n_groups"]) == (10, 5)
    assert by_group["design_effect"] == pytest.approx(2)
    assert by_group["success_low"] < by_map["success_low"]
    assert np.isfinite(by_map["total_time_low_s"])
    assert np.isnan(by_group["total_time_low_s"])  # of five there is none


def test_a_further_metric_has_students_interval_over_maps_and_counts_those_that_have_it() -> (
    None
):
    # Ten maps with two episodes each; of map 9 neither episode has a value.
    energies = np.arange(20.0) ** 2
    energies[18:] = np.nan
    episodes = rows(
        row(condition(), i // 2, realisation=i % 2, energy_j=energy)
        for i, energy in enumerate(energies)
    )
    worlds = {str(episodes["condition"][0]): made.PAPER["world"]}
    (found,) = summarise(episodes, worlds, [Energy().quantity]).to_dict("records")
    by_hand = energies[:18].reshape(9, 2).mean(1)
    half = t.ppf(0.975, 8) * by_hand.std(ddof=1) / 3
    assert found["energy_mean_j"] == pytest.approx(by_hand.mean())
    assert (found["energy_low_j"], found["energy_high_j"]) == pytest.approx(
        (by_hand.mean() - half, by_hand.mean() + half)
    )
    assert found["energy_std_j"] == pytest.approx(energies[:18].std(ddof=1))
    assert found["energy_n"] == 18
    # Where a part of a run does not have the column yet, nothing is known of it.
    (found,) = summarise(
        episodes.drop(columns="energy_j"), worlds, [Energy().quantity]
    ).to_dict("records")
    assert np.isnan([found["energy_mean_j"], found["energy_low_j"]]).all()
    assert found["energy_n"] == 0
