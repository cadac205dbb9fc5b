from itertools import product
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import permutation_test

from benchnav.stats.bootstrap import bootstrap_counts
from benchnav.stats.holm import holm
from benchnav.stats.scores import Score, Sums, against_best, compare_pairs, summarise


def ratio(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    quotient: np.ndarray = part.sum(-1) / whole.sum(-1)
    return quotient


def overlap(hits: np.ndarray, true: np.ndarray) -> np.ndarray:
    mean: np.ndarray = (hits / true).mean(-1)
    return mean


SCORES = (
    Score(name="accuracy", parts=("hits", "true"), of=overlap, better="higher"),
    Score(
        name="rmse",
        parts=("squares", "cells"),
        of=lambda a, b: np.sqrt(ratio(a, b)),
        better="lower",
    ),
    Score(name="loss", parts=("loss", "cells"), of=ratio, better="lower"),
    Score(name="coverage", parts=("inside", "cells"), of=ratio, target=0.9),
    Score(name="width", parts=("width", "cells"), of=ratio),
)
NAMES = [score.name for score in SCORES]


def sums_of(loss: Any, seed: int = 0) -> Sums:
    """Maps of 100 cells with these mean losses; all else at random."""
    random, maps = np.random.default_rng(seed), len(loss)
    true = random.integers(20, 40, (maps, 3)).astype(float)
    return {
        "cells": np.full(maps, 100.0),
        "loss": 100 * np.asarray(loss, dtype=float),
        "squares": 10 * random.random(maps),
        "width": 10 * random.random(maps),
        "inside": random.binomial(100, 0.9, maps).astype(float),
        "true": true,
        "hits": np.floor(true * random.random((maps, 3))),
    }


def compared(sums: dict[str, Sums], competing: str = "ab") -> pd.DataFrame:
    return compare_pairs(SCORES, sums, list(competing), "cells").set_index(
        ["measure", "one", "other"]
    )


@pytest.mark.parametrize("maps", [6, 9])
def test_a_mean_is_tested_as_scipy_tests_it(maps: int) -> None:
    random = np.random.default_rng(maps)
    one, other = random.random(maps), random.random(maps) + 0.2
    found = compared({"a": sums_of(one), "b": sums_of(other, 1)}).loc["loss", "a", "b"]
    exact = permutation_test(
        (one, other),
        lambda x, y: np.mean(x) - np.mean(y),
        permutation_type="samples",
        n_resamples=np.inf,
    )
    assert found["difference"] == pytest.approx(exact.statistic)
    assert found["p"] == found["p_holm"] == pytest.approx(exact.pvalue)


def test_what_is_no_mean_is_tested_by_exchanging_the_two_on_each_map() -> None:
    one, other = sums_of(np.ones(5)), sums_of(np.ones(5), 1)
    one = {**one, "inside": np.array([93.0, 96, 91, 94, 99])}
    other = {**other, "inside": np.array([86.0, 88, 92, 80, 85])}
    rows = compared({"a": one, "b": other})
    for score in SCORES:
        found = []
        for swap in product((False, True), repeat=5):
            sides = [
                {name: own[name].copy() for name in score.parts} for own in (one, other)
            ]
            for name in score.parts:
                sides[0][name][list(swap)], sides[1][name][list(swap)] = (
                    other[name][list(swap)],
                    one[name][list(swap)],
                )
            a, b = map(score.value, sides)
            if score.name == "coverage":
                a, b = abs(a - 0.9), abs(b - 0.9)
            found.append(float(a - b))
        expected = np.mean(np.abs(found) >= abs(found[0]) - 1e-12)
        assert rows.loc[score.name, "a", "b"]["difference"] == pytest.approx(
            found[0]
        ), score.name
        assert rows.loc[score.name, "a", "b"]["p"] == pytest.approx(expected), (
            score.name
        )


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 1000), st.integers(3, 20))
def test_nothing_depends_on_the_order_of_maps_or_contestants(
    seed: int, maps: int
) -> None:
    random = np.random.default_rng(seed)
    sums = {
        name: sums_of(random.random(maps), seed + place)
        for place, name in enumerate("abc")
    }
    order = random.permutation(maps)
    moved = {
        name: {part: values[order] for part, values in sums[name].items()}
        for name in "cab"
    }
    twice = {
        name: {part: 2 * values for part, values in own.items()}
        for name, own in sums.items()
    }
    expected, summary = compared(sums, "abc"), summarise(SCORES, sums)
    best = against_best(SCORES, summary, expected.reset_index()).set_index(
        "measure", append=True
    )
    for other in (moved, twice):
        rows, others = compared(other, "abc"), summarise(SCORES, other)
        pd.testing.assert_frame_equal(others.loc[list("abc")], summary, rtol=1e-9)
        for key, row in expected.iterrows():
            turned = key not in rows.index
            found = rows.loc[(key[0], key[2], key[1]) if turned else key]  # type: ignore[index]
            ends = (
                (-found["high"], -found["low"])
                if turned
                else (found["low"], found["high"])
            )
            sign = -1 if turned else 1
            assert sign * found["difference"] == pytest.approx(
                row["difference"], abs=1e-12
            )
            assert ends == pytest.approx(
                (row["low"], row["high"]), abs=1e-12, nan_ok=True
            )
            assert (found["p"], found["p_holm"]) == (row["p"], row["p_holm"])
        again = against_best(SCORES, others, rows.reset_index()).set_index(
            "measure", append=True
        )
        pd.testing.assert_frame_equal(
            again.loc[best.index], best, rtol=1e-9, atol=1e-12
        )


def test_an_interval_is_that_of_samples_of_maps() -> None:
    sums = sums_of(np.random.default_rng(2).random(25))
    found = summarise(SCORES, {"a": sums}).loc["a"]
    assert found["units"] == 25
    table = np.column_stack([sums["hits"], sums["true"]])
    drawn = bootstrap_counts(25) @ table[np.lexsort(table.T)]
    expected = np.quantile((drawn[:, :3] / drawn[:, 3:]).mean(1), [0.025, 0.975])
    assert (found["accuracy_low"], found["accuracy_high"]) == pytest.approx(
        tuple(expected)
    )
    few = summarise(SCORES, {"a": sums_of(np.ones(7))}).loc["a"]
    assert np.isnan([few["loss_low"], few["coverage_high"]]).all()
    pair = compared({"a": sums_of(np.ones(7)), "b": sums_of(np.zeros(7), 1)}).loc[
        "loss", "a", "b"
    ]
    assert np.isnan([pair["low"], pair["high"]]).all()
    assert pair["p"] == 2 / 2**7


def test_holm_is_over_the_pairs_that_compete_within_a_score() -> None:
    random = np.random.default_rng(4)
    sums = {
        name: sums_of(random.random(9) + place, place)
        for place, name in enumerate("abc")
    }
    pairs = compared({**sums, "oracle": sums_of(np.zeros(9), 7)}, "abc").reset_index()
    assert len(pairs) == 6 * len(SCORES)
    privileged = pairs["other"] == "oracle"
    assert pairs.loc[privileged, "p_holm"].isna().all()
    assert pairs.loc[privileged, "p"].notna().all()
    for _, rows in pairs[~privileged].groupby("measure"):
        np.testing.assert_array_equal(rows["p_holm"], holm(rows["p"].to_numpy()))


def test_maps_with_other_cells_and_scores_that_one_lacks_are_not_compared() -> None:
    one, other = sums_of(np.ones(9)), dict(sums_of(np.ones(9), 1))
    del other["hits"]
    assert set(compared({"a": one, "b": other}).index.get_level_values(0)) == {
        *NAMES
    } - {"accuracy"}
    other["loss"] = np.where(np.arange(9) == 2, np.nan, other["loss"])
    assert "loss" not in compared({"a": one, "b": other}).index
    assert compared({"a": one, "b": {**other, "cells": np.arange(9.0)}}).empty


def test_the_best_and_what_is_as_good_are_marked_where_something_is_worse() -> None:
    noise = np.random.default_rng(5).normal(0, 0.01, (3, 12))
    levels = {"bad": 0.5, "good": 0.1, "alike": 0.1}
    sums = {
        name: dict(sums_of(level + noise[i], i))
        for i, (name, level) in enumerate(levels.items())
    }
    for name, own in sums.items():
        own["hits"] = own["true"] * (0.45 if name == "bad" else 0.9)
        own["inside"] = np.full(12, 85.0 if name == "alike" else 90.0)
    pairs = compare_pairs(
        SCORES, {**sums, "oracle": sums_of(np.zeros(12), 9)}, list(sums), "cells"
    )
    found = against_best(SCORES, summarise(SCORES, sums), pairs)
    assert set(found["measure"]) == {*NAMES} - {"width"}
    by_loss, by_accuracy, by_coverage = (
        found[found["measure"] == name] for name in ("loss", "accuracy", "coverage")
    )
    for rows in (by_loss, by_accuracy):
        assert rows["marked"].to_dict() == {"bad": False, "good": True, "alike": True}
    assert by_loss["best"].iloc[0] in ("good", "alike")
    bad = by_loss.loc["bad"]
    assert bad["difference"] == pytest.approx(0.4, abs=0.02)
    assert bad["low"] < bad["difference"] < bad["high"]
    assert bad["p_holm"] < 0.05
    assert set(by_coverage["best"]) == {"bad"}  # of equal ones the first by name
    assert by_coverage.loc["alike", "difference"] == pytest.approx(0.05)
    assert by_coverage["marked"].to_dict() == {
        "bad": True,
        "good": True,
        "alike": False,
    }
    alone = against_best(SCORES, summarise(SCORES, {"bad": sums["bad"]}), pairs)
    assert set(alone["best"]) == {"bad"}
    assert not alone["marked"].any()


@pytest.mark.parametrize("maps", [5, 13, 40])
def test_against_one_without_any_error_every_way_counts(maps: int) -> None:
    least = 2 / 2**maps if maps <= 13 else 1 / 10_000
    for seed in range(20):
        one = {
            **sums_of(np.ones(maps)),
            "squares": np.random.default_rng(seed).random(maps),
        }
        other = {**one, "squares": np.zeros(maps)}
        assert (
            compared({"a": one, "b": other}).loc["rmse", "a", "b"]["p"] >= least * 0.99
        )
