import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy import stats
from torch import Tensor

from benchnav.core import rng
from benchnav.core.copula import correlated_normal
from benchnav.planning.sensing.gaussian import (
    Field,
    Observed,
    Posterior,
    condition,
    posterior,
    predict,
)
from benchnav.planning.sensing.truncated_normal import interval_moments

INF = float("inf")
SHAPE, LENGTH = (10, 11), 2.0
FIELD = Field.of(SHAPE, (LENGTH,), "cpu")


def cells(*places: tuple[int, int]) -> Tensor:
    return torch.tensor(places)


def covariance(one: Tensor, other: Tensor) -> ndarray:
    return FIELD.covariance(0, *(one[:, None] - other).unbind(-1)).numpy()


ELSEWHERE = cells((0, 0), (4, 5), (5, 5), (9, 10), (4, 8))


def known(*said: tuple[float, float, float]) -> Observed:
    lower, upper, std = np.array(said).T
    zero = np.zeros_like(lower)
    return Observed(lower=lower, upper=upper, std=std, precision=zero, shift=zero)


def told(where: Tensor, observed: Observed) -> tuple[Posterior, ndarray, ndarray]:
    found = condition(covariance(where, where), observed)
    return found, *found.moments(covariance(where, ELSEWHERE))[:2]


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        (-INF, 0.3),
        (0.3, INF),
        (-0.4, 0.2),
        (2.0, 2.1),
        (-INF, -3.0),
        (3.0, INF),
        (-6.0, -5.9),
    ],
)
@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (1.5, 0.5), (-1.0, 2.0)])
def test_moments_of_an_interval_are_those_of_a_truncated_normal(
    lower: float, upper: float, mean: float, std: float
) -> None:
    given = [np.array(value) for value in (mean, std**2, lower, upper)]
    found_mean, found_variance = interval_moments(*given)
    other = stats.truncnorm((lower - mean) / std, (upper - mean) / std, mean, std)
    assert float(found_mean) == pytest.approx(other.mean(), abs=1e-6)
    assert float(found_variance) == pytest.approx(other.var(), rel=1e-3, abs=1e-8)


def test_far_out_in_a_tail_the_moments_stay_numbers() -> None:
    one = np.array(1.0)
    for lower, upper in ((30.0, INF), (-INF, -35.0), (38.0, 39.0)):
        mean, variance = interval_moments(0 * one, one, lower * one, upper * one)
        assert lower <= float(mean) <= upper
        assert 0 < float(variance) < 0.01


def test_numbers_condition_as_linear_algebra_says() -> None:
    where = cells((4, 4), (5, 6), (0, 1))
    value, std = np.array([1.2, -0.7, 0.4]), np.array([0.1, 0.5, 1e-3])
    _, mean, variance = told(
        where,
        known(*((v, v, s) for v, s in zip(value.tolist(), std.tolist(), strict=True))),
    )
    inner = covariance(where, where) + np.diag(std**2)
    across = covariance(where, ELSEWHERE)
    np.testing.assert_allclose(
        mean, across.T @ np.linalg.solve(inner, value), atol=1e-9
    )
    np.testing.assert_allclose(
        variance, 1 - (across * np.linalg.solve(inner, across)).sum(0), atol=1e-9
    )


@pytest.mark.parametrize(
    "count", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)]
)
def test_two_observations_leave_the_fields_of_the_world_that_match_them(
    count: int,
) -> None:
    """By keeping those of many fields of the world's generator that match, one number
    and one interval.
    """
    where = cells((4, 4), (5, 6))
    found, at_once = [], 50_000
    for part in range(count // at_once):
        drawn = correlated_normal(
            rng.stream_key(3, part), np.arange(at_once), SHAPE, LENGTH
        )
        one, other = np.random.default_rng(part).normal(0, 0.2, (2, at_once))
        number, interval = drawn[:, 4, 4] + one, drawn[:, 5, 6] + other
        keep = (abs(number - 0.3) < 0.05) & (interval < -0.3)
        found.append(drawn[keep][:, *ELSEWHERE.T.numpy()])
    kept = np.concatenate(found)
    assert len(kept) > count / 200
    _, mean, variance = told(where, known((0.3, 0.3, 0.2), (-INF, -0.3, 0.2)))
    error = kept.std(0) / np.sqrt(len(kept))
    assert (abs(mean - kept.mean(0)) < 4 * error + 0.005).all()
    np.testing.assert_allclose(np.sqrt(variance), kept.std(0), atol=0.05)


def gibbs(where: Tensor, observed: Observed, sweeps: int, chains: int) -> np.ndarray:
    """Scores of the observed cells by long chains of a Gibbs sampler, shape [chains ·
    kept, N].
    """
    generator = np.random.default_rng(1)
    inner = covariance(where, where)
    count = len(inner)
    std, lower, upper = observed.std, observed.lower, observed.upper
    full = inner + np.diag(std**2)  # of what was observed, with its noise
    precision = np.linalg.inv(full)
    y = np.where(
        np.isinf(lower), np.where(np.isinf(upper), 0.0, upper - 0.1), lower + 0.1
    )
    y = np.tile(np.where(upper > lower, y, lower), (chains, 1))
    kept = []
    for sweep in range(sweeps):
        for i in range(count):
            if upper[i] > lower[i]:
                spread = precision[i, i] ** -0.5
                rest = y @ precision[i] - y[:, i] * precision[i, i]
                centre = -rest / precision[i, i]
                low, high = (
                    stats.norm.cdf((lower[i] - centre) / spread),
                    stats.norm.cdf((upper[i] - centre) / spread),
                )
                y[:, i] = centre + spread * stats.norm.ppf(
                    low + (high - low) * generator.random(chains)
                )
        if sweep >= sweeps // 5:
            # The score behind each, given all that was observed.
            mean = y @ np.linalg.solve(full, inner)
            left = inner - inner @ np.linalg.solve(full, inner)
            kept.append(
                generator.multivariate_normal(np.zeros(count), left, chains) + mean
            )
    return np.concatenate(kept)


@pytest.mark.parametrize("std", [1e-3, 0.1])
def test_many_intervals_have_the_moments_of_long_gibbs_chains(std: float) -> None:
    where = cells((3, 3), (3, 4), (4, 3), (4, 4), (4, 5), (6, 6), (7, 8), (8, 2))
    observed = known(
        (-INF, -0.9, std), (-INF, -0.6, std), (-0.2, -0.2, std), (-INF, -1.1, std), (-0.3, 0.6, std),
        (0.3, 0.3, std), (1.0, INF, std), (-INF, -0.4, std),
    )  # fmt: skip
    drawn = gibbs(where, observed, sweeps=400, chains=150)
    found = condition(covariance(where, where), observed)
    mean, variance, _ = found.moments(covariance(where, where))
    _, _, skew = predict(
        found, covariance(where, where), observed, covariance(where, where)
    )
    away = (drawn - drawn.mean(0)) / drawn.std(0)
    held = observed.upper > observed.lower
    np.testing.assert_allclose(skew[held], (away**3).mean(0)[held], atol=0.25)
    np.testing.assert_allclose(mean, drawn.mean(0), atol=0.04)
    np.testing.assert_allclose(np.sqrt(variance), drawn.std(0), atol=0.09)


@pytest.mark.parametrize(
    ("lower", "upper"), [(-INF, -0.8), (0.2, INF), (-0.3, 0.9), (-INF, -6.5)]
)
def test_beside_an_interval_a_score_is_as_skew_as_the_fields_that_match(
    lower: float, upper: float
) -> None:
    """In closed form: of a cell of correlation r with one that is truncated, r³ times
    its third moment.
    """
    where = cells((4, 4))
    observed = known((lower, upper, 0.3))
    inner, block = covariance(where, where), covariance(where, ELSEWHERE)
    found = condition(inner, observed)
    mean, variance, skew = predict(found, inner, observed, block)
    np.testing.assert_allclose((mean, variance), found.moments(block)[:2], atol=1e-9)
    total = np.sqrt(1.09)
    seen = stats.truncnorm(lower / total, upper / total, scale=total)
    third = seen.stats("s") * seen.std() ** 3 / total**6
    expected = block[0] ** 3 * third / variance**1.5
    np.testing.assert_allclose(skew, np.clip(expected, -2, 2), atol=0.01)
    assert abs(expected).max() > 0.01


def test_nothing_known_leaves_the_field_as_it_is() -> None:
    where = cells((3, 3))
    zero = np.zeros(1)
    mean, variance, _ = posterior(covariance(where, where), zero, zero).moments(
        covariance(where, ELSEWHERE)
    )
    assert (mean == 0).all()
    assert (variance == 1).all()
