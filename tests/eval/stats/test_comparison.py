from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest, t, wilcoxon

from benchnav.eval.stats.comparison import compare
from benchnav.eval.stats.pairs import Pair
from benchnav.stats.episodes import time_difference
from benchnav.stats.intervals import standard_deviation, success_interval
from benchnav.stats.power import maps_needed, smallest_difference


def pair(
    one: list[float],
    other: list[float],
    names: tuple[str, str] = ("cvar", "mean"),
    draws: int = 1,
    budgets_s: tuple[float, float] = (100.0, 100.0),
) -> Pair:
    """Times of two conditions by episode, T of a failure; `draws` episodes in a row are
    on one map.
    """
    maps = np.arange(len(one)) // draws
    episodes = pd.DataFrame({"map": maps, "group": maps})
    for suffix, times, budget_s in (
        ("", one, budgets_s[0]),
        ("_other", other, budgets_s[1]),
    ):
        episodes[f"success{suffix}"] = np.array(times) < budget_s
        episodes[f"total_time_s{suffix}"] = times
        episodes[f"time_budget_s{suffix}"] = budget_s
    return Pair(
        one=names[0], other=names[1], shared={"planner": "mppi"}, episodes=episodes
    )


A = [30.0, 35, 100, 40, 31, 100, 33, 36]
B = [29.0, 100, 100, 100, 30, 28, 32, 100]


def test_a_pair_of_one_episode_a_map() -> None:
    (row,) = compare([pair(A, B)]).to_dict("records")
    assert (
        row["one"],
        row["other"],
        row["planner"],
        row["n_maps"],
        row["n_episodes"],
    ) == (
        "cvar",
        "mean",
        "mppi",
        8,
        8,
    )
    assert (row["success_one"], row["success_other"]) == (6 / 8, 4 / 8)
    gain = np.array([0, 1, 0, 1, 0, -1, 0, 1])
    _, low, high = success_interval(gain, 1)
    assert (
        row["success_difference"],
        row["success_low"],
        row["success_high"],
    ) == pytest.approx((0.25, low, high))
    assert row["success_p"] == pytest.approx(binomtest(3, 4).pvalue)
    late = np.array(A) - B
    assert row["time_difference_s"] == pytest.approx(late.mean())
    assert row["time_low_s"] < late.mean() < row["time_high_s"]
    assert row["time_p"] == pytest.approx(wilcoxon(late).pvalue)
    # Both arrived on the first, fifth and seventh map, each a second later.
    assert (row["arrival_time_difference_s"], row["arrival_time_n_maps"]) == (1, 3)
    std = float(standard_deviation(gain, 1))
    assert row["success_detectable"] == pytest.approx(smallest_difference(std, 8, 0.05))
    assert row["maps_needed"] == maps_needed(std, 0.05, 0.05)


def test_episodes_of_a_map_are_one_number() -> None:
    (row,) = compare([pair(A, B, draws=2)]).to_dict("records")
    assert (row["n_maps"], row["n_episodes"], row["success_difference"]) == (4, 8, 0.25)
    gain = np.array([1, 1, -1, 1])
    assert row["success_low"] == pytest.approx(success_interval(gain, 2)[1])
    assert row["success_p"] == pytest.approx(10 / 16)  # of 16 ways to set four signs
    assert row["time_p"] == pytest.approx(wilcoxon([-32, -30, 36.5, -31.5]).pvalue)
    assert row["arrival_time_n_maps"] == 3


def test_holm_is_over_all_pairs_for_each_measure() -> None:
    generator = np.random.default_rng(0)
    times = [
        np.where(generator.random(60) < rate, 30 + generator.random(60), 100)
        for rate in (0.5, 0.6, 0.8, 0.9)
    ]
    pairs = [pair(list(times[i]), list(times[0]), (str(i), "0")) for i in (1, 2, 3)]
    table = compare(pairs)
    for name in ("success_p", "time_p"):
        ordered = np.sort(table[name])
        expected = np.maximum.accumulate(ordered * [3, 2, 1]).clip(max=1)
        np.testing.assert_allclose(np.sort(table[f"{name}_holm"]), expected)
    alone = compare(pairs[:1])
    assert alone["success_p_holm"][0] == alone["success_p"][0]
    # What can be shown is at the level of the first step.
    assert table["success_detectable"][0] > alone["success_detectable"][0]
    assert table["maps_needed"][0] > alone["maps_needed"][0]


def test_maps_are_counted_for_the_difference_that_is_asked_for() -> None:
    few, many = (
        compare([pair(A, B)], difference)["maps_needed"][0]
        for difference in (0.2, 0.02)
    )
    assert many == pytest.approx(100 * few, rel=0.05)


def test_pairs_of_which_never_both_arrived_have_no_time_of_arrival() -> None:
    (row,) = compare([pair([30.0, 100], [100.0, 30])]).to_dict("records")
    assert np.isnan(row["arrival_time_difference_s"])
    assert row["arrival_time_n_maps"] == 0


def test_a_difference_of_time_knows_what_failures_cost() -> None:
    """Both arrive everywhere and as fast as each other: what few maps could not show is
    in the interval.
    """
    same = [30.0 + i % 3 for i in range(20)]
    _, low, high = time_difference(pair(same, same).episodes)
    _, fewer, more = success_interval(np.zeros(20, dtype=int), 1)
    cost = 100 - np.mean(same)
    assert (low, high) == pytest.approx((cost * fewer, cost * more))
    narrow = time_difference(pair(same, same).episodes, confidence=0.5)
    assert low < narrow[1] < narrow[2] < high
    late = [time + 5 for time in same]
    difference, low, high = time_difference(pair(late, same).episodes)
    assert difference == pytest.approx(5)
    assert (low + high) / 2 == pytest.approx(5)


def test_a_difference_of_time_separates_the_cost_of_failures() -> None:
    # The first condition fails on 4 of 20 maps, and is as fast on all others.
    other = [30.0 + i % 3 for i in range(20)]
    failed = np.arange(20) < 4
    first = np.where(failed, 100.0, other)
    difference, low, high = time_difference(pair(first.tolist(), other).episodes)
    assert difference == pytest.approx((first - other).mean())
    times = np.concatenate((first[~failed], other))
    penalty = 100 - times.mean()
    rest = first - other - penalty * failed  # what no failure explains
    half_width = t.ppf(0.975, 15) * rest.std(ddof=1) / np.sqrt(20)
    _, *ends = success_interval(np.where(failed, -1, 0), 1)
    below = np.hypot(half_width, penalty * (0.2 + ends[1]))
    above = np.hypot(half_width, penalty * (-ends[0] - 0.2))
    assert low == pytest.approx(difference - below)
    assert high == pytest.approx(difference + above)


def test_a_group_of_maps_is_one_number() -> None:
    given = pair(A, B)
    grouped = replace(given, episodes=given.episodes.assign(group=np.arange(8) // 2))
    (row,) = compare([grouped]).to_dict("records")
    (by_map,) = compare([pair(A, B, draws=2)]).to_dict("records")
    assert (row.pop("n_maps"), row["n_groups"], row["n_episodes"]) == (8, 4, 8)
    assert by_map.pop("n_maps") == 4
    assert repr(row) == repr(by_map)


def test_maps_with_unequally_many_draws_all_count() -> None:
    """Twenty maps under seed 0, of which nine under seed 1 too: a map that both arrived
    on more often has its share.
    """
    one, other = [30.0] * 29, [30.0] * 20 + [100.0] * 9
    given = pair(one, other)
    given.episodes["map"] = [*range(20), *range(9)]
    (row,) = compare([given]).to_dict("records")
    assert (row["n_maps"], row["n_episodes"]) == (20, 29)
    assert row["success_difference"] == pytest.approx(9 / 29)
    assert row["success_one"] - row["success_other"] == pytest.approx(9 / 29)
    assert row["success_p"] == pytest.approx(2 / 2**9)


def test_times_under_unlike_budgets_are_compared_in_shares_of_them() -> None:
    """A slow robot and one of thrice its speed that ends each drive alike: it has a
    third of the time.
    """
    slow = np.array([30.0, 60, 300, 45, 300, 90, 75, 33])
    (seconds,) = compare(
        [pair(list(slow), list(slow / 3), budgets_s=(300.0, 300.0))]
    ).to_dict("records")
    assert seconds["time_difference_s"] == pytest.approx((slow - slow / 3).mean())
    given = pair(list(slow), list(slow / 3), budgets_s=(300.0, 100.0))
    table = compare([given, pair(A, B)])
    assert table["time_difference_share"].to_numpy() == pytest.approx(
        [0, (np.array(A) - B).mean() / 100]
    )
    assert not {"time_difference_s", "time_low_s", "time_high_s"} & set(table)
    assert table["time_p"][0] == 1
    late = (np.array(A) - B) / 100
    assert table["time_p"][1] == pytest.approx(wilcoxon(late).pvalue)
    # Of episodes in which both arrived there is no penalty, so that their seconds can
    # be compared.
    assert table["arrival_time_difference_s"][0] == pytest.approx(
        (slow - slow / 3)[slow < 300].mean()
    )


def test_an_episode_that_began_at_its_goal_took_no_share() -> None:
    given = pair([0.0, 30.0, 60.0], [20.0, 10.0, 20.0], budgets_s=(300.0, 100.0))
    given.episodes.loc[0, "time_budget_s"] = np.nan
    (row,) = compare([given]).to_dict("records")
    assert row["time_difference_share"] == pytest.approx((0 - 0.2 + 0 + 0) / 3)
