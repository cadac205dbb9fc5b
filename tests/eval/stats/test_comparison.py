import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest, wilcoxon

from benchnav.eval.stats.comparison import compare, time_difference
from benchnav.eval.stats.difference import standard_deviation, success_interval
from benchnav.eval.stats.pairing import Pair
from benchnav.eval.stats.power import maps_needed, smallest_difference


def pair(
    one: list[float], other: list[float], names: tuple[str, str] = ("cvar", "mean"), draws: int = 1
) -> Pair:
    """Times of two trials by episode, 100 s of a failure; `draws` episodes in a row are on one map."""
    episodes = pd.DataFrame({"instance": np.arange(len(one)) // draws})
    for suffix, times in (("", one), ("_other", other)):
        episodes[f"success{suffix}"] = np.array(times) < 100
        episodes[f"total_time_s{suffix}"] = times
        episodes[f"time_budget_s{suffix}"] = 100.0
    return Pair(one=names[0], other=names[1], shared={"planner": "mppi"}, episodes=episodes, left_out=0)


A = [30.0, 35, 100, 40, 31, 100, 33, 36]
B = [29.0, 100, 100, 100, 30, 28, 32, 100]


def test_a_pair_of_one_episode_a_map() -> None:
    (row,) = compare([pair(A, B)]).to_dict("records")
    assert (row["one"], row["other"], row["planner"], row["n_maps"], row["n_draws"]) == (
        "cvar",
        "mean",
        "mppi",
        8,
        1,
    )
    assert (row["success_one"], row["success_other"]) == (6 / 8, 4 / 8)
    gain = np.array([0, 1, 0, 1, 0, -1, 0, 1])
    _, low, high = success_interval(gain, 1)
    assert (row["success_difference"], row["success_low"], row["success_high"]) == pytest.approx(
        (0.25, low, high)
    )
    assert row["success_p"] == pytest.approx(binomtest(3, 4).pvalue)
    late = np.array(A) - B
    assert row["time_difference_s"] == pytest.approx(late.mean())
    assert row["time_low_s"] < late.mean() < row["time_high_s"]
    assert row["time_p"] == pytest.approx(wilcoxon(late).pvalue)
    # Both arrived on the first, fifth and seventh map, each a second later.
    assert (row["arrival_time_difference_s"], row["arrival_time_n_maps"]) == (1, 3)
    std = float(standard_deviation(gain, 1))
    assert row["success_shown"] == pytest.approx(smallest_difference(std, 8, 0.05))
    assert row["maps_needed"] == maps_needed(std, 0.05, 0.05)


def test_episodes_of_a_map_are_one_number() -> None:
    (row,) = compare([pair(A, B, draws=2)]).to_dict("records")
    assert (row["n_maps"], row["n_draws"], row["success_difference"]) == (4, 2, 0.25)
    gain = np.array([1, 1, -1, 1])
    assert row["success_low"] == pytest.approx(success_interval(gain, 2)[1])
    assert row["success_p"] == pytest.approx(10 / 16)  # of 16 ways to set four signs
    assert row["time_p"] == pytest.approx(wilcoxon([-32, -30, 36.5, -31.5]).pvalue)
    assert row["arrival_time_n_maps"] == 3


def test_holm_is_over_all_pairs_for_each_measure() -> None:
    generator = np.random.default_rng(0)
    times = [
        np.where(generator.random(60) < rate, 30 + generator.random(60), 100) for rate in (0.5, 0.6, 0.8, 0.9)
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
    assert table["success_shown"][0] > alone["success_shown"][0]
    assert table["maps_needed"][0] > alone["maps_needed"][0]


def test_maps_are_counted_for_the_difference_that_is_asked_for() -> None:
    few, many = (compare([pair(A, B)], difference)["maps_needed"][0] for difference in (0.2, 0.02))
    assert many == pytest.approx(100 * few, rel=0.05)


def test_pairs_of_which_never_both_arrived_have_no_time_of_arrival() -> None:
    (row,) = compare([pair([30.0, 100], [100.0, 30])]).to_dict("records")
    assert np.isnan(row["arrival_time_difference_s"])
    assert row["arrival_time_n_maps"] == 0


def test_so_few_maps_have_no_interval_of_time() -> None:
    few, enough = (compare([pair(A[:n], B[:n])]).iloc[0] for n in (7, 8))
    for name in ("time_low_s", "time_high_s"):
        assert np.isnan(few[name])
        assert np.isfinite(enough[name])
    assert np.isfinite(few["time_difference_s"])


def test_a_difference_of_time_knows_what_failures_cost() -> None:
    """Both arrive everywhere and as fast as each other: what few maps could not show is in the interval."""
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


@pytest.mark.parametrize("maps", [8, 20])
def test_intervals_of_a_difference_of_time_cover_it_on_few_maps(maps: int) -> None:
    generator = np.random.default_rng(8)
    held, count, rates = 0, 150, (0.85, 0.95)
    for _ in range(count):
        hard, luck = generator.standard_normal(maps), generator.random(maps)
        taken = [
            np.where(
                luck < rate,
                np.minimum(33 * np.exp(0.2 * hard + 0.2 * generator.standard_normal(maps)), 99),
                100,
            )
            for rate in rates
        ]
        _, low, high = time_difference(pair(*(list(times) for times in taken)).episodes)
        held += low <= 0.1 * (100 - 33 * np.exp(0.04)) <= high
    assert held >= 135  # 93 % of 150 are 139.5


def test_maps_of_one_group_are_one_number() -> None:
    one = pair(A, B)
    one.episodes["group"] = one.episodes["instance"] // 2
    (row,) = compare([one]).to_dict("records")
    (expected,) = compare([pair(A, B, draws=2)]).to_dict("records")
    assert row == pytest.approx(expected, nan_ok=True)
    assert row["n_maps"] == 4
