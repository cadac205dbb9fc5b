from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import bootstrap, permutation_test

from benchnav.core.resampling import bootstrap_counts, holm
from benchnav.models.quality.compare.paired import (
    HIGHER,
    LOWER,
    MEASURES,
    against_best,
    compare_pairs,
    summarise,
)
from benchnav.models.quality.map_sums import added, measures_of

Sums = dict[str, np.ndarray]


def sums_of(crps: list[float] | np.ndarray, seed: int = 0, classes: bool = True) -> Sums:
    """Maps of 100 cells with these mean CRPS; all else at random."""
    random, maps = np.random.default_rng(seed), len(crps)
    sums: Sums = {"cells": np.full(maps, 100.0), "crps": 100 * np.asarray(crps, dtype=float)}
    for name in ("squares", "expected_squares", "nll", "pinball", "width", "areas"):
        sums[name] = 10 * random.random(maps)
    sums["labelled"] = sums["cells"].copy()
    for name, share in (("inside", 0.9), ("under_80", 0.2), ("under_90", 0.1), ("under_95", 0.05)):
        sums[name] = random.binomial(100, share, maps).astype(float)
    if classes:
        sums["true"] = random.integers(20, 40, (maps, 3)).astype(float)
        sums["hits"] = np.floor(sums["true"] * random.random((maps, 3)))
        sums["found"] = sums["true"]
    return sums


def holm_of_statsmodels(p: np.ndarray | list[float]) -> np.ndarray:
    from statsmodels.stats.multitest import multipletests

    with patch("gc.collect"):  # which it calls each time, for a fifth of a second
        corrected: np.ndarray = multipletests(p, method="holm")[1]
    return corrected


def row(pairs: pd.DataFrame, measure: str, one: str = "a", other: str = "b") -> dict[str, float]:
    rows = pairs[(pairs["measure"] == measure) & (pairs["one"] == one) & (pairs["other"] == other)]
    (found,) = rows.to_dict("records")
    return {str(name): value for name, value in found.items()}


def test_every_measure_has_a_way_that_is_better_but_the_width() -> None:
    assert {*HIGHER, *LOWER, "coverage", "width"} == set(MEASURES)


@pytest.mark.parametrize("maps", [6, 9])
def test_a_mean_is_tested_as_scipy_tests_it(maps: int) -> None:
    random = np.random.default_rng(maps)
    one, other = random.random(maps), random.random(maps) + 0.2
    found = row(compare_pairs("s", {"a": sums_of(one), "b": sums_of(other, 1)}, ["a", "b"]), "crps")
    exact = permutation_test(
        (one, other), lambda x, y: np.mean(x) - np.mean(y), permutation_type="samples", n_resamples=np.inf
    )
    assert found["difference"] == pytest.approx(exact.statistic)
    assert found["p"] == pytest.approx(exact.pvalue)
    assert found["p_holm"] == found["p"]


def test_what_is_no_mean_is_tested_by_exchanging_the_models_on_each_map() -> None:
    one, other = sums_of(np.ones(5)), sums_of(np.ones(5), 1)
    one["inside"], other["inside"] = np.array([93.0, 96, 91, 94, 99]), np.array([86.0, 88, 92, 80, 85])
    pairs = compare_pairs("s", {"a": one, "b": other}, ["a", "b"])
    values: dict[str, list[float]] = {"rmse_observed": [], "miou": [], "tail_error": [], "coverage": []}
    for way in range(2**5):
        swap = np.array([bool(way >> place & 1) for place in range(5)])
        first, second = (
            {n: np.where(swap.reshape(-1, *[1] * (own[n].ndim - 1)), others[n], own[n]).sum(0) for n in own}
            for own, others in ((one, other), (other, one))
        )
        gained = [measures_of(sums) for sums in (first, second)]
        for name, found in values.items():
            a, b = (abs(own[name] - 0.9) if name == "coverage" else own[name] for own in gained)
            found.append(float(a - b))
    for name, found in values.items():
        wanted = np.mean(np.abs(found) >= abs(found[0]) - 1e-12)
        assert row(pairs, name)["difference"] == pytest.approx(found[0]), name
        assert row(pairs, name)["p"] == pytest.approx(wanted), name


def test_to_name_the_models_the_other_way_turns_the_signs() -> None:
    one, other = sums_of(np.random.default_rng(0).random(12)), sums_of(np.random.default_rng(1).random(12), 1)
    forward = compare_pairs("s", {"a": one, "b": other}, ["a", "b"])
    backward = compare_pairs("s", {"b": other, "a": one}, ["a", "b"])
    assert len(forward) == len(MEASURES)
    for name in MEASURES:
        there, back = row(forward, name), row(backward, name, "b", "a")
        assert there["difference"] == pytest.approx(-back["difference"])
        assert (there["low"], there["high"]) == pytest.approx((-back["high"], -back["low"]))
        assert there["p"] == back["p"]


def test_the_interval_is_that_of_a_bootstrap_over_maps() -> None:
    values = np.random.default_rng(2).random(25)
    found = summarise("s", {"a": sums_of(values)}).iloc[0]
    exact = bootstrap(
        (values,), np.mean, method="percentile", n_resamples=9_999, rng=np.random.default_rng(0)
    ).confidence_interval
    assert (found["crps_low"], found["crps_high"]) == pytest.approx((exact.low, exact.high), abs=0.01)
    assert found["crps"] == pytest.approx(values.mean())
    assert found["units"] == 25
    counts = bootstrap_counts(25)
    assert counts.shape == (2000, 25)
    assert (counts.sum(1) == 25).all()
    drawn = measures_of(added(sums_of(values), counts))["miou"]
    assert (found["miou_low"], found["miou_high"]) == pytest.approx(tuple(np.quantile(drawn, [0.025, 0.975])))


def test_few_maps_have_no_interval() -> None:
    few = summarise("s", {"a": sums_of(np.ones(7))}).iloc[0]
    assert np.isnan([few["crps_low"], few["coverage_high"]]).all()
    found = row(compare_pairs("s", {"a": sums_of(np.ones(7)), "b": sums_of(np.zeros(7), 1)}, []), "crps")
    assert np.isnan([found["low"], found["high"]]).all()
    assert found["p"] == 2 / 2**7


@given(st.lists(st.floats(0, 1), min_size=1, max_size=20))
def test_holms_correction_is_that_of_statsmodels(p: list[float]) -> None:
    np.testing.assert_allclose(holm(np.array(p)), holm_of_statsmodels(p))


def test_holm_is_over_the_pairs_of_models_that_compete_within_a_measure() -> None:
    random = np.random.default_rng(4)
    sums = {name: sums_of(random.random(9) + place, place) for place, name in enumerate("abc")}
    sums["oracle"] = sums_of(np.zeros(9), 7)
    pairs = compare_pairs("s", sums, ["a", "b", "c"])
    assert len(pairs) == 6 * len(MEASURES)
    with_oracle = pairs["other"] == "oracle"
    assert pairs.loc[with_oracle, "p_holm"].isna().all()
    assert pairs.loc[with_oracle, "p"].notna().all()
    for _, rows in pairs[~with_oracle].groupby("measure"):
        wanted = holm_of_statsmodels(rows["p"].to_numpy())
        np.testing.assert_allclose(rows["p_holm"].to_numpy(float), wanted)


def test_models_on_other_cells_and_measures_that_one_lacks_are_not_compared() -> None:
    one, other = sums_of(np.ones(9)), sums_of(np.ones(9), 1, classes=False)
    found = set(compare_pairs("s", {"a": one, "b": other}, [])["measure"])
    assert found == set(MEASURES) - {"accuracy", "miou"}
    other["nll"][2] = np.nan
    assert "nll" not in set(compare_pairs("s", {"a": one, "b": other}, [])["measure"])
    other["cells"][0] = 99
    assert compare_pairs("s", {"a": one, "b": other}, []).empty


def test_the_best_and_what_is_as_good_are_marked_where_something_is_worse() -> None:
    maps = 12
    noise = np.random.default_rng(5).normal(0, 0.01, (3, maps))
    sums = {name: sums_of(level + noise[place], place) for place, (name, level) in enumerate(
        [("bad", 0.5), ("good", 0.1), ("alike", 0.1)]
    )}  # fmt: skip
    sums["oracle"] = sums_of(np.zeros(maps), 9)
    for values in sums.values():  # equally often right, but for `bad`
        values["hits"] = values["true"] * 0.9
        values["inside"][:] = 90
    sums["bad"]["hits"] *= 0.5
    sums["alike"]["inside"][:] = 91
    names = ["bad", "good", "alike"]
    found = against_best(summarise("s", sums), compare_pairs("s", sums, names), names)
    assert set(found["model"]) == set(names)
    assert "width" not in set(found["measure"])
    marked = found[found["marked"]].groupby("measure")["model"].agg(set).to_dict()
    assert marked["crps"] == {"good", "alike"}
    assert marked["accuracy"] == {"good", "alike"}
    by_crps = found[found["measure"] == "crps"].set_index("model")
    best = by_crps["best"].iloc[0]
    assert best in ("good", "alike")
    assert by_crps.loc["bad", "difference"] == pytest.approx(0.4, abs=0.02)
    assert by_crps.loc["bad", "low"] < by_crps.loc["bad", "difference"] < by_crps.loc["bad", "high"]
    assert by_crps.loc["bad", "p_holm"] < 0.05
    by_coverage = found[found["measure"] == "coverage"].set_index("model")
    assert by_coverage["best"].iloc[0] in ("bad", "good")
    assert by_coverage.loc["alike", "difference"] == pytest.approx(0.01)
    assert not by_coverage.loc["alike", "marked"]


def test_alone_a_model_is_the_best_and_not_marked() -> None:
    sums = {"a": sums_of(np.ones(9)), "oracle": sums_of(np.zeros(9), 1)}
    found = against_best(summarise("s", sums), compare_pairs("s", sums, ["a"]), ["a"])
    assert set(found["best"]) == {"a"}
    assert not found["marked"].any()


@pytest.mark.parametrize("maps", [5, 13, 40])
def test_against_a_model_without_any_error_every_way_has_a_chance(maps: int) -> None:
    one, least = sums_of([0.1] * maps), 2 / 2**maps if maps <= 13 else 1 / 10_000
    for seed in range(20):
        other = {**one, "expected_squares": np.zeros(maps)}
        own = {**one, "expected_squares": np.random.default_rng(seed).random(maps)}
        p = row(compare_pairs("std", {"a": own, "b": other}, ["a"]), "rmse_expected")["p"]
        assert p >= least * 0.99
