"""The simulated studies of benchmarks/statistics_studies.py, at small size."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
import statistics_studies as studies


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.mark.parametrize("draws", [1, 3])
def test_intervals_of_success_hold_it(generator: np.random.Generator, draws: int) -> None:
    cover = list(studies.cover_of_success(generator, 400, 50, draws, (0.05, 0.35, 0.5, 0.65)))
    assert 0.93 < np.mean(cover) < 0.97
    assert min(cover) >= 0.9


@pytest.mark.parametrize("draws", [1, 3])
def test_intervals_of_differences_hold_them(generator: np.random.Generator, draws: int) -> None:
    cover = list(studies.cover_of_differences(generator, 400, 50, draws, (0.1, 0.5, 0.9)))
    assert 0.93 < np.mean(cover) < 0.97
    assert min(cover) >= 0.9


def test_intervals_of_times_hold_them(generator: np.random.Generator) -> None:
    cover = list(studies.cover_of_times(generator, 40, 50, 1, (0.5,)))
    assert 0.9 < np.mean(cover) < 0.99


@pytest.mark.parametrize("draws", [1, 3])
def test_settings_that_are_alike_are_rarely_told_apart(generator: np.random.Generator, draws: int) -> None:
    found = np.array(list(studies.false_findings(generator, 40, 50, draws, (0.5,))))
    assert np.all(found.mean(0) < 0.1)  # 120 studies of 0.05 lie below this


def test_what_is_simulated_has_the_rates_and_the_likeness_asked_for(generator: np.random.Generator) -> None:
    chance = studies.chances(generator, np.array([0.2, 0.7]), (40, 500), 0.3, 0.8)
    np.testing.assert_allclose(chance.mean((0, 2)), [0.2, 0.7], atol=0.01)
    # Variance of chances over p(1 − p) is the correlation within a map.
    np.testing.assert_allclose(chance.var((0, 2)), 0.3 * np.array([0.16, 0.21]), rtol=0.05)
    same = np.full((40, 2, 500), 0.5)
    alike = studies.outcomes(generator, same, 1, 0.8)
    assert np.mean(alike[:, 0] == alike[:, 1]) == pytest.approx(0.5 + 0.5 * 0.64, abs=0.01)
    assert studies.times(generator, np.ones(20_000, dtype=bool)).mean() == pytest.approx(35, abs=0.3)
