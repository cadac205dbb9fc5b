"""Exact forms of quantile distributions, against the quantile function integrated
otherwise.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.quantiles import LEVELS, QuantileDistribution
from tests.core.distributions import quantiles

LAW = quantiles(4)
# Within each interval of the levels midpoints of equal shares: exact of what is linear
# there.
SPLITS = 400
EDGES = np.array(LEVELS)
NODES = (
    EDGES[:-1, None] + np.diff(EDGES)[:, None] * (np.arange(SPLITS) + 0.5) / SPLITS
).ravel()
SHARES = np.repeat(np.diff(EDGES) / SPLITS, SPLITS)


def sampled(law: QuantileDistribution) -> torch.Tensor:
    """λ at the nodes by NumPy's interpolation, shape [N, *B, H, W]."""
    knots = law.values.double().movedim(-3, -1)
    found = [
        np.interp(NODES, EDGES, own) for own in knots.reshape(-1, len(LEVELS)).numpy()
    ]
    return torch.from_numpy(np.stack(found, -1)).view(-1, *law.shape)


def weighted(values: torch.Tensor) -> torch.Tensor:
    return torch.einsum("n...,n->...", values, torch.from_numpy(SHARES))


def test_the_levels_are_dense_where_risk_is() -> None:
    assert len(LEVELS) == 72
    assert LEVELS[0] == 0
    assert LEVELS[-1] == 1
    assert sum(level <= 0.1 for level in LEVELS) == 25
    assert list(LEVELS) == sorted(set(LEVELS))


def test_quantiles_are_linear_between_the_levels() -> None:
    for probability in (0.0, 0.001, 0.0042, 0.1, 0.333, 0.98, 1.0):
        wanted = [
            np.interp(probability, EDGES, own)
            for own in LAW.values.movedim(1, -1).reshape(-1, 72).numpy()
        ]
        torch.testing.assert_close(
            LAW.quantile(probability).flatten(),
            torch.tensor(wanted, dtype=torch.float64),
        )
        found = LAW.quantile(torch.full(LAW.shape, probability, dtype=torch.float64))
        torch.testing.assert_close(
            found.flatten(), torch.tensor(wanted, dtype=torch.float64)
        )


@pytest.mark.parametrize("value", [-0.1, 0.0, 0.05, 0.2, 0.5, 0.9, 1.0, 1.2])
def test_the_cdf_is_the_share_of_quantiles_up_to_a_value(value: float) -> None:
    draws = sampled(LAW)
    lower, upper = LAW.cdf_limits(value)
    torch.testing.assert_close(
        upper, weighted((draws <= value).double()), rtol=0, atol=1e-3
    )
    torch.testing.assert_close(
        lower, weighted((draws < value).double()), rtol=0, atol=1e-3
    )
    torch.testing.assert_close(
        LAW.chance(value), weighted((draws >= value).double()), rtol=0, atol=1e-3
    )
    assert torch.equal(LAW.cdf(value), upper)


def test_an_atom_is_all_in_the_cdf_and_not_under_it() -> None:
    values = torch.tensor(LEVELS, dtype=torch.float64)
    values = torch.where((values >= 0.2) & (values <= 0.5), 0.2, values)
    law = QuantileDistribution(values.view(72, 1, 1))
    for value, lower, upper in (
        (0.1, 0.1, 0.1),
        (0.2, 0.2, 0.5),
        (0.3, 0.50625, 0.50625),
        (0.52, 0.52, 0.52),
    ):
        found = [share.item() for share in law.cdf_limits(value)]
        assert found == pytest.approx([lower, upper], abs=1e-12)
    assert [score.item() for score in law.to_normal(0.2)] == pytest.approx(
        [-0.8416, 0.0], abs=1e-4
    )
    assert law.quantile(0.35).item() == pytest.approx(0.2)


def test_all_in_one_place_is_a_point() -> None:
    law = QuantileDistribution(torch.full((72, 1, 1), 0.3, dtype=torch.float64))
    assert [share.item() for share in law.cdf_limits(0.3)] == [0, 1]
    for found in (law.mean(), law.cvar(0.9), law.var(0.5), 1 / law.expected_time(0.1)):
        assert found.item() == pytest.approx(0.3)
    assert 1 / law.expected_time(0.4).item() == pytest.approx(0.4)
    assert law.crps(torch.tensor([[0.9]])).item() == pytest.approx(0.6)


@pytest.mark.parametrize("level", [0.0, 0.5, 0.735, 0.9, 0.99, 0.9995])
def test_the_cvar_is_the_mean_of_the_lowest_quantiles(level: float) -> None:
    nodes = (np.arange(20_000) + 0.5) / 20_000 * (1 - level)
    knots = LAW.values.movedim(1, -1).reshape(-1, 72).numpy()
    wanted = torch.tensor(
        [np.interp(nodes, EDGES, own).mean() for own in knots], dtype=torch.float64
    )
    torch.testing.assert_close(LAW.cvar(level).flatten(), wanted, rtol=0, atol=1e-5)
    if level == 0:
        torch.testing.assert_close(LAW.mean().flatten(), wanted, rtol=0, atol=1e-5)
        assert bool((LAW.var(level) == 1).all())


@pytest.mark.parametrize("floor", [0.05, 0.3])
@pytest.mark.parametrize("level", [0.0, 0.5, 0.83])
def test_the_tail_of_the_time_is_that_of_the_least_ranks(
    level: float, floor: float
) -> None:
    nodes = (np.arange(20_000) + 0.5) / 20_000 * (1 - level)
    knots = LAW.values.movedim(1, -1).reshape(-1, 72).numpy()
    times = [(1 / np.interp(nodes, EDGES, own).clip(floor)).mean() for own in knots]
    found = LAW.time_cvar(level, floor).flatten()
    torch.testing.assert_close(
        found, torch.tensor(times, dtype=torch.float64), rtol=1e-4, atol=0
    )


@pytest.mark.parametrize("floor", [0.01, 0.05, 0.3, 1.0])
def test_the_expected_time_is_that_of_the_quantiles(floor: float) -> None:
    wanted = weighted(1 / sampled(LAW).clamp(min=floor))
    torch.testing.assert_close(LAW.expected_time(floor), wanted, rtol=1e-4, atol=0)


def test_the_crps_is_that_of_pairs_of_quantiles() -> None:
    # E|λ − y| − ½ E|λ − λ′|; of sorted draws the second is a weighted sum.
    draws = sampled(LAW)
    ranks = torch.from_numpy(np.cumsum(SHARES) - SHARES / 2).view(-1, 1, 1, 1)
    spread = weighted(draws * (2 * ranks - 1))
    for value in (0.0, 0.2, 0.55, 1.0):
        observed = torch.full(LAW.shape, value, dtype=torch.float64)
        wanted = weighted((draws - value).abs()) - spread
        torch.testing.assert_close(LAW.crps(observed), wanted, rtol=0, atol=2e-5)


def test_quantiles_have_no_density_and_learn_by_their_integrals() -> None:
    assert bool(LAW.log_prob(torch.full(LAW.shape, 0.5)).isnan().all())
    values = LAW.values.clone().requires_grad_()
    law = replace(LAW, values=values)
    (
        law.crps(torch.full(LAW.shape, 0.5)) + law.cvar(0.9) + law.expected_time(0.05)
    ).sum().backward()
    assert values.grad is not None
    assert bool(values.grad.isfinite().all())


SPACED = tuple(np.linspace(0, 1, 80).tolist())


@pytest.mark.parametrize(
    ("levels", "expected"),
    [
        (LEVELS[:60], "at least 64 `levels`, got 60"),
        (LEVELS[1:], "ascend from 0 to 1"),
        (LEVELS[:-1], "ascend from 0 to 1"),
        ((*LEVELS[:-2], 1.0, 0.999), "ascend from 0 to 1"),
        ((0.0, *LEVELS), "ascend from 0 to 1"),
        ((math.nan, *LEVELS), "ascend from 0 to 1"),
        (
            SPACED,
            "at most 0.01 apart in the tail up to 0.1, got a step of 0.0127",
        ),
    ],
)
def test_levels_that_are_none_are_refused(
    levels: tuple[float, ...], expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        QuantileDistribution(torch.zeros(2, len(levels), 3, 3), levels)


@pytest.mark.parametrize("shape", [(2, 71, 3, 3), (72, 3)])
def test_values_that_do_not_fit_the_levels_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ConfigError, match=r"shape \[\*B, 72, H, W\]"):
        QuantileDistribution(torch.zeros(shape))
