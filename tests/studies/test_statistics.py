"""The simulated studies of statistics, at small size."""

import numpy as np
import pytest

from studies.statistics import simulated as studies


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.mark.parametrize("draws", [1, 3])
def test_intervals_of_success_and_of_differences_hold_them(
    generator: np.random.Generator, draws: int
) -> None:
    rates, pairs = (0.05, 0.35, 0.5, 0.65), (0.1, 0.5, 0.9)
    for cover, own in (
        (studies.cover_of_success, rates),
        (studies.cover_of_differences, pairs),
    ):
        found = list(cover(generator, 400, 50, draws, own))
        assert 0.93 < np.mean(found) < 0.97
        assert min(found) >= 0.9


def test_intervals_of_times_cover_them_where_a_bootstrap_does_not(
    generator: np.random.Generator,
) -> None:
    cover, width = studies.cover_of_times(
        generator, 200, (20, 1), (0.95, 0.85), 60
    ).T.to_numpy()
    time, by_bootstrap, difference, _ = cover
    assert min(time, difference) > 0.93
    assert by_bootstrap < time
    assert width[1] < width[0] < 25


def test_what_is_as_good_as_the_best_is_rarely_called_worse(
    generator: np.random.Generator,
) -> None:
    """Were each tested against the best alone, some of twelve would be called worse in
    one study of seven.
    """
    tied, half = (
        studies.called_worse(
            studies.drives(generator, rates, (count, 50), 1, studies.LIKENESS[1])[
                0
            ].sum(-1),
            1,
        )
        for rates, count in (([0.8] * 12, 150), ([0.9] * 6 + [0.3] * 6, 100))
    )
    assert tied.any(1).sum() <= 14  # 150 studies of 5 % lie above once in a hundred
    assert half[:, :6].any(1).sum() <= 11
    assert half[:, 6:].mean() > 0.95


def test_intervals_of_few_large_groups_hold_what_a_cluster_t_does_not(
    generator: np.random.Generator,
) -> None:
    found = studies.cover_of_groups(generator, 300, 5, 20, (0.99, 0.9), (0.3, 0.0))
    assert found["cover"] > 0.93 > 0.85 > found["cover_t"]
    assert found["half"] < 1.7 * found["half_t"]
    assert min(found["cover_0"], found["cover_1"]) > 0.93


def test_what_is_simulated_has_the_rates_and_the_likeness_asked_for(
    generator: np.random.Generator,
) -> None:
    chance = studies.chances(generator, (0.2, 0.7), (40, 500), (0.3, 0.8))
    np.testing.assert_allclose(chance.mean((0, 2)), [0.2, 0.7], atol=0.01)
    # Variance of chances over p(1 − p) is the correlation within a map.
    np.testing.assert_allclose(
        chance.var((0, 2)), 0.3 * np.array([0.16, 0.21]), rtol=0.05
    )
    same = np.full((40, 2, 500), 0.5)
    alike = studies.outcomes(generator, same, 1, 0.8)
    assert np.mean(alike[:, 0] == alike[:, 1]) == pytest.approx(
        0.5 + 0.5 * 0.64, abs=0.01
    )
    hard = studies.hardness(chance, (0.2, 0.7), 0.3)
    np.testing.assert_allclose(
        (hard.mean((0, 2)), hard.std((0, 2))), ([0, 0], [1, 1]), atol=0.03
    )
    taken = studies.times(generator, np.ones((*hard.shape, 1), dtype=bool), hard)
    assert taken.mean() == pytest.approx(33 * np.exp(0.045), abs=0.3)
    # whole steps
    np.testing.assert_allclose(10 * taken, np.rint(10 * taken), atol=1e-9)
    assert np.corrcoef(taken.ravel(), chance.ravel())[0, 1] < -0.4
