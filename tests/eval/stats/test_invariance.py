"""Tests and intervals say the same of the same episodes, however they are counted,
ordered, named or rounded.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.stats import wilcoxon

from benchnav.eval.experiment.hypotheses import Hypothesis
from benchnav.eval.stats.best import against_best
from benchnav.eval.stats.comparison import compare
from benchnav.eval.stats.hypotheses import p_of
from benchnav.eval.stats.pairs import Pair
from benchnav.eval.stats.summary import success_mean, total_time_mean
from benchnav.stats.best import best_set_p
from benchnav.stats.by_map import by_map
from benchnav.stats.episodes import summed_differences
from benchnav.stats.flips import signed_rank_p
from tests.eval.report import made
from tests.eval.stats.test_regret import episodes as regret_episodes
from tests.eval.stats.test_regret import split

STEP_S = 0.1
COLUMNS = ("success", "total_time_s", "time_budget_s", "score")
TESTS = [
    Hypothesis(
        one="a", other="b", metric=metric, kind=kind, direction=direction, margin=margin
    )
    for metric, margin in (("success", 10.0), ("T_total", 5.0), ("score", 0.05))
    for kind, direction in (
        *(("difference", direction) for direction in ("", "higher", "lower")),
        ("non-inferiority", "higher"),
    )
]
# No shrinking: a table of episodes gets no shorter, and each try is slow.
few = settings(deadline=None, max_examples=12, phases=[Phase.explicit, Phase.generate])


@st.composite
def pairs(draw: st.DrawFn) -> pd.DataFrame:
    """Episodes of two conditions on a grid of time steps; many end alike, and T is any
    number.
    """
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n_maps, draws = (
        draw(st.integers(2, 18)),
        draw(st.sampled_from([1, 2, 3, 5, 6, 7, 10])),
    )
    member = np.repeat(np.arange(n_maps), draws)
    if draw(st.booleans()):  # unequally many
        member = np.sort(np.append(member, generator.integers(0, n_maps, n_maps)))
    budget_s = draw(
        st.sampled_from([np.full(n_maps, 100.0), generator.uniform(60, 120, n_maps)])
    )[member]
    rows = pd.DataFrame(
        {
            "map": member,
            "group": member,
            "seed": np.arange(len(member)),
            "realisation": 0,
        }
    )
    steps = generator.integers(250, 260, len(member))
    for suffix in ("", "_other"):
        differs = generator.random(n_maps)[member] < draw(
            st.sampled_from([0.0, 0.3, 1.0])
        )
        steps = np.where(
            differs & (suffix != ""),
            steps + generator.integers(-3, 4, len(member)),
            steps,
        )
        success = ~(differs & (generator.random(len(member)) < 0.3))
        rows[f"success{suffix}"] = success
        rows[f"total_time_s{suffix}"] = np.where(success, steps * STEP_S, budget_s)
        rows[f"time_budget_s{suffix}"] = budget_s
        rows[f"score{suffix}"] = np.where(success, 12.5 / (steps * STEP_S), 0.0)
    return rows


def numbers(rows: pd.DataFrame) -> dict[str, float]:
    """All that tests and intervals say of a pair, but how many episodes it has."""
    pair = Pair(one="a", other="b", shared={}, episodes=rows)
    (row,) = (
        compare([pair]).drop(columns=["one", "other", "n_episodes"]).to_dict("records")
    )
    tests = {
        f"{test.metric}, {test.kind} {test.direction}": p_of(test, rows)
        for test in TESTS
    }
    world = {"time_budget_ratio": 3.0}
    one = rows.assign(time_ratio=3 * rows["total_time_s"] / rows["time_budget_s"])
    ends = {f"rate {i}": value for i, value in enumerate(success_mean(one))}
    ends |= {f"time {i}": value for i, value in enumerate(total_time_mean(one, world))}
    return row | tests | ends


def repeated(rows: pd.DataFrame) -> pd.DataFrame:
    return pd.concat([rows, rows.assign(seed=rows["seed"] + 1000)], ignore_index=True)


def shuffled(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.sample(frac=1, random_state=3, ignore_index=True)


def relabelled(rows: pd.DataFrame) -> pd.DataFrame:
    new = 7 + 11 * rows["map"].max() - 11 * rows["map"]
    return rows.assign(map=new, group=new)


def noisy(rows: pd.DataFrame) -> pd.DataFrame:
    generator = np.random.default_rng(4)
    times = [name for name in rows if name.startswith("total_time_s")]
    return rows.assign(
        **{
            name: rows[name] + generator.choice([-1e-12, 1e-12], len(rows))
            for name in times
        }
    )


CHANGES: list[Callable[[pd.DataFrame], pd.DataFrame]] = [
    repeated,
    shuffled,
    relabelled,
    noisy,
]


@few
@given(rows=pairs())
def test_a_pair_is_the_same_however_its_episodes_are_counted(
    rows: pd.DataFrame,
) -> None:
    expected = numbers(rows)
    for change in CHANGES:
        found = numbers(change(rows))
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-6, nan_ok=True), (
            change.__name__
        )


@few
@given(rows=pairs(), added=st.integers(1, 6))
def test_maps_without_a_difference_do_not_count_in_tests_by_signs_and_ranks(
    rows: pd.DataFrame, added: int
) -> None:
    alike = rows.head(added).assign(
        map=1000 + np.arange(added), group=1000 + np.arange(added)
    )
    alike = alike.assign(**{f"{name}_other": alike[name] for name in COLUMNS})
    more = pd.concat([alike, rows], ignore_index=True)
    for test in (test for test in TESTS if test.kind == "difference"):
        assert p_of(test, more) == pytest.approx(p_of(test, rows), rel=1e-9), test
    expected, found = (signed_rank_p(summed_differences(one)) for one in (rows, more))
    assert found == pytest.approx(expected, rel=1e-9)


@few
@given(rows=pairs())
def test_ranks_are_those_of_whole_steps(rows: pd.DataFrame) -> None:
    rows = rows[rows["success"] & rows["success_other"]]
    late = np.rint((rows["total_time_s"] - rows["total_time_s_other"]) / STEP_S).astype(
        int
    )
    sums = late.groupby(rows["group"]).sum().to_numpy()
    found = summed_differences(rows)
    np.testing.assert_array_equal(found == 0, sums == 0)
    assert len(np.unique(np.abs(found))) == len(np.unique(np.abs(sums)))
    differing = sums[sums != 0].astype(float)
    if len(differing) > 13:
        assert signed_rank_p(found) == pytest.approx(wilcoxon(differing).pvalue)


@pytest.mark.parametrize("draws", [3, 6, 10])
def test_maps_that_ended_alike_are_no_evidence(draws: int) -> None:
    """Of 40 maps 28 end alike under both and 12 differ by chance; rounding has found a
    difference in up to 55 %.
    """
    generator = np.random.default_rng(draws)
    maps, studies, found = np.repeat(np.arange(40), draws), 200, 0
    for _ in range(studies):
        late = np.zeros((40, draws))
        late[:12] = np.round(generator.normal(0, 5, (12, draws)), 1)
        values = by_map(late.ravel(), maps)
        assert not values[12:].any()
        found += signed_rank_p(values) < 0.05
    assert found <= 20  # of 5 % once in a thousand times


def best_rows() -> pd.DataFrame:
    """Four settings, of which two are equally good but for their times, on 20 maps
    under three seeds.
    """
    generator = np.random.default_rng(2)
    noise = generator.random((20, 3))
    steps = generator.integers(250, 400, (20, 3))
    episodes: list[dict[str, Any]] = []
    for risk, rate, slower in (
        ("b", 0.8, 0),
        ("a", 0.8, 1),
        ("c", 0.6, 0),
        ("d", 0.1, 0),
    ):
        for map_index, seed in np.ndindex(20, 3):
            time_s = (
                (steps[map_index, seed] + slower) * STEP_S
                if noise[map_index, seed] < rate
                else None
            )
            episodes.append(
                made.row(made.condition(risk=risk), map_index, time_s, seed=seed)
            )
    return made.rows(*episodes)


@pytest.mark.parametrize("change", CHANGES)
def test_the_best_is_the_same_however_its_episodes_are_counted(
    change: Callable[[pd.DataFrame], pd.DataFrame],
) -> None:
    rows = best_rows()
    expected, found = (
        against_best(one, made.summarised(one)).set_index("condition").sort_index()
        for one in (rows, change(rows))
    )
    assert expected["best_p"].min() < 0.05 < expected["best_p"].max()
    kept = [name for name in expected if name != "best_episodes"]
    pd.testing.assert_frame_equal(found[kept], expected[kept], rtol=1e-9)


@few
@given(st.data())
def test_the_best_set_does_not_depend_on_any_order(data: st.DataObject) -> None:
    maps, count, draws = (
        data.draw(st.integers(*ends)) for ends in ((6, 15), (2, 5), (1, 4))
    )
    generator = np.random.default_rng(data.draw(st.integers(0, 1000)))
    wins = generator.binomial(draws, generator.uniform(0.2, 1, count), (maps, count))
    expected = best_set_p(wins, draws)
    order = generator.permutation(maps)
    for found in (best_set_p(wins[order], draws), best_set_p(3 * wins, 3 * draws)):
        np.testing.assert_array_equal(found, expected)
    # Two that won as often are in the order they came in, which samples depend on.
    if len(set(wins.sum(0))) == count:
        columns = generator.permutation(count)
        np.testing.assert_array_equal(
            best_set_p(wins[:, columns], draws), np.array(expected)[:, columns]
        )


@pytest.mark.parametrize("change", CHANGES)
def test_regret_is_the_same_however_its_episodes_are_counted(
    change: Callable[[pd.DataFrame], pd.DataFrame],
) -> None:
    rows = regret_episodes()
    expected, found = (
        split(one).drop(columns="n_episodes") for one in (rows, change(rows))
    )
    pd.testing.assert_frame_equal(found, expected, rtol=1e-6)
