import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from benchnav.core import rng
from benchnav.core.copula import correlated_normal
from benchnav.planning.sensing.gaussian import (
    Cells,
    Field,
    Observed,
    Posterior,
    condition,
    interval_moments,
    posterior,
    predict,
)

INF = float("inf")
SHAPE, LENGTH = (10, 11), 2.0
FIELD = Field.of(SHAPE, (LENGTH,), "cpu")


def cells(*places: tuple[int, int]) -> Cells:
    row, column = torch.tensor(places).T
    return Cells(row=row[None], column=column[None])


ELSEWHERE = cells((0, 0), (4, 5), (5, 5), (9, 10), (4, 8))


def known(*said: tuple[float, float, float]) -> Observed:
    lower, upper, std = torch.tensor(said, dtype=torch.float64).T[:, None]
    zero = torch.zeros_like(lower)
    return Observed(
        lower=lower, upper=upper, std=std, precision=zero, shift=zero, there=torch.ones_like(zero).bool()
    )


def told(where: Cells, observed: Observed) -> tuple[Posterior, Tensor, Tensor]:
    found = condition(FIELD.covariance(where, where), observed)
    return found, *found.moments(FIELD.covariance(where, ELSEWHERE))


@pytest.mark.parametrize(
    ("lower", "upper"),
    [(-INF, 0.3), (0.3, INF), (-0.4, 0.2), (2.0, 2.1), (-INF, -3.0), (3.0, INF), (-6.0, -5.9)],
)
@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (1.5, 0.5), (-1.0, 2.0)])
def test_moments_of_an_interval_are_those_of_a_truncated_normal(
    lower: float, upper: float, mean: float, std: float
) -> None:
    given = [torch.tensor(value, dtype=torch.float64) for value in (mean, std**2, lower, upper)]
    found_mean, found_variance = interval_moments(*given)
    other = stats.truncnorm((lower - mean) / std, (upper - mean) / std, mean, std)
    assert float(found_mean) == pytest.approx(other.mean(), abs=1e-6)
    assert float(found_variance) == pytest.approx(other.var(), rel=1e-3, abs=1e-8)


def test_far_out_in_a_tail_the_moments_stay_numbers() -> None:
    one = torch.tensor(1.0, dtype=torch.float64)
    for lower, upper in ((30.0, INF), (-INF, -35.0), (38.0, 39.0)):
        mean, variance = interval_moments(0 * one, one, lower * one, upper * one)
        assert lower <= float(mean) <= upper
        assert 0 < float(variance) < 0.01


def test_numbers_condition_as_linear_algebra_says() -> None:
    where = cells((4, 4), (5, 6), (0, 1))
    value, std = np.array([1.2, -0.7, 0.4]), np.array([0.1, 0.5, 1e-3])
    _, mean, variance = told(
        where, known(*((v, v, s) for v, s in zip(value.tolist(), std.tolist(), strict=True)))
    )
    inner = FIELD.covariance(where, where)[0].numpy() + np.diag(std**2)
    across = FIELD.covariance(where, ELSEWHERE)[0].numpy()
    np.testing.assert_allclose(mean[0], across.T @ np.linalg.solve(inner, value), atol=1e-9)
    np.testing.assert_allclose(variance[0], 1 - (across * np.linalg.solve(inner, across)).sum(0), atol=1e-9)


@pytest.mark.parametrize("count", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_two_observations_leave_the_fields_of_the_world_that_match_them(count: int) -> None:
    """By keeping those of many fields of the world's generator that match, one number and one interval."""
    where = cells((4, 4), (5, 6))
    found, at_once = [], 50_000
    for part in range(count // at_once):
        drawn = correlated_normal(rng.stream_key(3, part), np.arange(at_once), SHAPE, LENGTH)
        one, other = np.random.default_rng(part).normal(0, 0.2, (2, at_once))
        number, interval = drawn[:, 4, 4] + one, drawn[:, 5, 6] + other
        keep = (abs(number - 0.3) < 0.05) & (interval < -0.3)
        found.append(drawn[keep][:, ELSEWHERE.row[0].numpy(), ELSEWHERE.column[0].numpy()])
    kept = np.concatenate(found)
    assert len(kept) > count / 200
    _, mean, variance = told(where, known((0.3, 0.3, 0.2), (-INF, -0.3, 0.2)))
    error = kept.std(0) / np.sqrt(len(kept))
    assert (abs(mean[0].numpy() - kept.mean(0)) < 4 * error + 0.005).all()
    np.testing.assert_allclose(variance[0].sqrt(), kept.std(0), atol=0.05)


def gibbs(where: Cells, observed: Observed, sweeps: int, chains: int) -> np.ndarray:
    """Scores of the observed cells by long chains of a Gibbs sampler, shape [chains · kept, N]."""
    generator = np.random.default_rng(1)
    inner = FIELD.covariance(where, where)[0].numpy()
    count = len(inner)
    std, lower, upper = (getattr(observed, name)[0].numpy() for name in ("std", "lower", "upper"))
    full = inner + np.diag(std**2)  # of what was observed, with its noise
    precision = np.linalg.inv(full)
    y = np.where(np.isinf(lower), np.where(np.isinf(upper), 0.0, upper - 0.1), lower + 0.1)
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
                y[:, i] = centre + spread * stats.norm.ppf(low + (high - low) * generator.random(chains))
        if sweep >= sweeps // 5:
            # The score behind each, given all that was observed.
            mean = y @ np.linalg.solve(full, inner)
            left = inner - inner @ np.linalg.solve(full, inner)
            kept.append(generator.multivariate_normal(np.zeros(count), left, chains) + mean)
    return np.concatenate(kept)


@pytest.mark.parametrize("std", [1e-3, 0.1])
def test_many_intervals_have_the_moments_of_long_gibbs_chains(std: float) -> None:
    where = cells((3, 3), (3, 4), (4, 3), (4, 4), (4, 5), (6, 6), (7, 8), (8, 2))
    observed = known(
        (-INF, -0.9, std), (-INF, -0.6, std), (-0.2, -0.2, std), (-INF, -1.1, std), (-0.3, 0.6, std),
        (0.3, 0.3, std), (1.0, INF, std), (-INF, -0.4, std),
    )  # fmt: skip
    drawn = gibbs(where, observed, sweeps=400, chains=150)
    found = condition(FIELD.covariance(where, where), observed)
    mean, variance = found.moments(FIELD.covariance(where, where))
    _, _, skew = predict(found, FIELD.covariance(where, where), observed, FIELD.covariance(where, where))
    away = (drawn - drawn.mean(0)) / drawn.std(0)
    held = (observed.upper > observed.lower)[0].numpy()
    np.testing.assert_allclose(skew[0][held], (away**3).mean(0)[held], atol=0.25)
    np.testing.assert_allclose(mean[0], drawn.mean(0), atol=0.04)
    np.testing.assert_allclose(variance[0].sqrt(), drawn.std(0), atol=0.09)


@pytest.mark.parametrize(("lower", "upper"), [(-INF, -0.8), (0.2, INF), (-0.3, 0.9), (-INF, -6.5)])
def test_beside_an_interval_a_score_is_as_skew_as_the_fields_that_match(lower: float, upper: float) -> None:
    """In closed form: of a cell of correlation r with one that is truncated, r³ times its third moment."""
    where = cells((4, 4))
    observed = known((lower, upper, 0.3))
    inner, block = FIELD.covariance(where, where), FIELD.covariance(where, ELSEWHERE)
    found = condition(inner, observed)
    mean, variance, skew = predict(found, inner, observed, block)
    plain = found.moments(block)
    torch.testing.assert_close((mean, variance), plain, atol=1e-9, rtol=0)
    total = np.sqrt(1.09)
    seen = stats.truncnorm(lower / total, upper / total, scale=total)
    third = seen.stats("s") * seen.std() ** 3 / total**6
    expected = block[0, 0].numpy() ** 3 * third / variance[0].numpy() ** 1.5
    np.testing.assert_allclose(skew[0], np.clip(expected, -2, 2), atol=0.01)
    assert abs(expected).max() > 0.01


def test_a_fields_terms_do_not_depend_on_the_others_nor_on_empty_places() -> None:
    where = cells((3, 3), (3, 4), (6, 6))
    hard = known((-INF, -2.5, 0.01), (0.8, 0.8, 0.01), (1.0, INF, 0.1))
    alone = condition(FIELD.covariance(where, where), hard)
    pad = torch.zeros(1, 2, dtype=torch.int64)
    wide = Cells(row=torch.cat((where.row, pad), 1), column=torch.cat((where.column, pad), 1))
    both = Cells(row=wide.row.repeat(2, 1), column=wide.column.repeat(2, 1))

    def widen(name: str, empty: float, easy: float) -> Tensor:
        own = torch.cat((getattr(hard, name), torch.full((1, 2), empty, dtype=torch.float64)), 1)
        return torch.cat((own, torch.full_like(own, easy)))

    there = torch.tensor([[1, 1, 1, 0, 0], [1, 0, 0, 0, 0]]).bool()
    batch = condition(
        FIELD.covariance(both, both),
        Observed(
            lower=widen("lower", 0, 0.3), upper=widen("upper", 0, 0.3), std=widen("std", 1, 0.1),
            precision=widen("precision", 0, 0), shift=widen("shift", 0, 0), there=there,
        ),
    )  # fmt: skip
    torch.testing.assert_close(batch.precision[:1, :3], alone.precision, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(batch.shift[:1, :3], alone.shift, rtol=1e-9, atol=1e-9)
    assert (batch.precision[0, 3:] == 0).all()


def test_nothing_known_leaves_the_field_as_it_is() -> None:
    where = cells((3, 3))
    zero = torch.zeros(1, 1, dtype=torch.float64)
    mean, variance = posterior(FIELD.covariance(where, where), zero, zero).moments(
        FIELD.covariance(where, ELSEWHERE)
    )
    assert (mean == 0).all()
    assert (variance == 1).all()
