import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest, wilcoxon

from benchnav.eval.stats.comparison import compare
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
    few, enough = (compare([pair(A[:n], B[:n])]).iloc[0] for n in (5, 6))
    for name in ("time_low_s", "time_high_s"):
        assert np.isnan(few[name])
        assert np.isfinite(enough[name])
    assert np.isfinite(few["time_difference_s"])
