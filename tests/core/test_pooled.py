"""Pooled distributions: the average of CDFs."""

import math
from dataclasses import replace

import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.pooled import PooledDistribution, pool
from benchnav.testing.breaches import Breaches
from benchnav.testing.distribution import check_functions
from tests.core.distributions import Hidden, mixture, quantiles

MEMBERS = (
    mixture(3, 0.01, 0.3),
    mixture(3, 0.01, 0.3, seed=1),
    mixture(3, 0.01, 0.3, seed=2),
)
OBSERVED = torch.full(MEMBERS[0].shape, 0.4, dtype=torch.float64)


def average(name: str, *arguments: object) -> torch.Tensor:
    return torch.stack([getattr(own, name)(*arguments) for own in MEMBERS]).mean(0)


def test_mixtures_of_the_same_classes_become_one_mixture() -> None:
    found = pool(
        [
            replace(own, weights=2 * own.weights) if own is MEMBERS[0] else own
            for own in MEMBERS
        ]
    )
    assert isinstance(found, TraversabilityMixture)
    assert found.group == (0, 1, 2) * 3
    for name, arguments in (
        ("cdf", (0.3,)),
        ("mean", ()),
        ("expected_time", (0.05,)),
        ("class_probabilities", (3,)),
    ):
        torch.testing.assert_close(
            getattr(found, name)(*arguments),
            average(name, *arguments),
            rtol=1e-6,
            atol=1e-6,
        )
    bare = pool([replace(own, group=None) for own in MEMBERS])
    assert isinstance(bare, TraversabilityMixture)
    assert bare.group is None


@pytest.mark.parametrize("hide", [True, False])
def test_any_others_average_their_cdfs(hide: bool) -> None:
    law = pool(
        [Hidden(MEMBERS[0]) if hide else replace(MEMBERS[0], group=None), *MEMBERS[1:]]
    )
    exact = pool(MEMBERS)
    assert isinstance(law, PooledDistribution)
    for name, arguments in (
        ("cdf", (0.3,)), ("mean", ()), ("cvar", (0.9,)), ("chance", (0.0,)), ("chance", (1.0,)), ("quantile", (0.2,)),
        ("var", (0.9,)), ("crps", (OBSERVED,)),
    ):  # fmt: skip
        # The mixture's own CRPS is less exact where components are narrow.
        wanted = getattr(Hidden(exact) if name == "crps" else exact, name)(*arguments)
        torch.testing.assert_close(
            getattr(law, name)(*arguments), wanted, rtol=0, atol=1e-4
        )
    torch.testing.assert_close(
        law.expected_time(0.05), exact.expected_time(0.05), rtol=1e-4, atol=0
    )
    torch.testing.assert_close(
        law.time_cvar(0.8, 0.05), exact.time_cvar(0.8, 0.05), rtol=1e-4, atol=0
    )
    density = law.log_prob(OBSERVED)
    if hide:
        assert bool(density.isnan().all())
    else:
        torch.testing.assert_close(density, exact.log_prob(OBSERVED), rtol=0, atol=1e-9)
        whole = sum(own.log_prob(OBSERVED).exp() for own in MEMBERS) / 3
        torch.testing.assert_close(density.exp(), whole, rtol=1e-9, atol=1e-12)


def test_its_quantiles_are_the_inverse_of_a_cdf_that_jumps() -> None:
    law = pool([quantiles(), quantiles(1), MEMBERS[0]])
    atoms = 0
    for probability in (0.0, 0.05, 0.3, 0.62, 0.95, 1.0):
        value = law.quantile(probability)
        lower, upper = law.cdf_limits(value)
        assert bool((upper >= probability - 1e-9).all())
        assert bool((law.cdf(value - 1e-9) <= probability + 1e-9).all())
        atoms += int((upper - lower > 1e-3).sum())
    assert atoms > 10
    certain = [
        replace(own, means=torch.full_like(own.means, -1.0), stds=0 * own.stds)
        for own in MEMBERS[:2]
    ]
    assert bool((pool([Hidden(certain[0]), certain[1]]).quantile(0.7) == 0).all())
    firm = [
        replace(own, means=torch.full_like(own.means, 2.0), stds=0 * own.stds)
        for own in MEMBERS[:2]
    ]
    assert bool((pool([Hidden(firm[0]), firm[1]]).quantile(0.7) == 1).all())


def test_members_count_by_their_weights_in_each_cell() -> None:
    shares = torch.rand(
        2, 2, 5, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    shares = torch.stack((shares[:, 0], 1 - shares[:, 0]), 1)
    one, other = MEMBERS[:2]
    law = PooledDistribution((one, other), shares)
    whole = TraversabilityMixture(
        torch.cat((one.weights * shares[:, :1], other.weights * shares[:, 1:]), 1),
        torch.cat((one.means, other.means), 1),
        torch.cat((one.stds, other.stds), 1),
    )
    for name, arguments in (
        ("cdf", (0.3,)), ("mean", ()), ("cvar", (0.9,)), ("quantile", (0.2,)), ("expected_time", (0.05,)),
        ("log_prob", (OBSERVED,)), ("chance", (1.0,)),
    ):  # fmt: skip
        found, wanted = getattr(law, name)(*arguments), getattr(whole, name)(*arguments)
        torch.testing.assert_close(
            found, wanted, rtol=1e-5, atol=1e-4 if name == "cvar" else 1e-6
        )
    breaches = Breaches("distribution", "pooled")
    check_functions(law, 1e-4, breaches)
    breaches.raise_any()
    which = OBSERVED > 0
    which[0] = False
    assert torch.equal(law.at(which).cdf(0.4), law.cdf(0.4)[which][None])
    assert torch.equal(law.select(torch.tensor([1])).cdf(0.4), law.cdf(0.4)[1:])
    with pytest.raises(ConfigError, match="weights"):
        PooledDistribution((one, other), shares[:, :1])


def test_a_pool_is_taken_apart_with_its_members() -> None:
    law = pool([quantiles(), MEMBERS[0]])
    kept = law.select(torch.tensor([1]))
    assert torch.equal(kept.cdf(0.4), law.cdf(0.4)[1:])
    which = OBSERVED > 0
    which[0] = False
    assert torch.equal(law.at(which).cdf(0.4), law.cdf(0.4)[which][None])
    assert law.to("meta").members[1].device.type == "meta"
    assert law.dtype == torch.float64
    assert math.isclose(float(law.cdf(1.0).min()), 1.0)


def test_one_is_itself_and_none_or_unlike_ones_are_refused() -> None:
    assert pool([MEMBERS[0]]) is MEMBERS[0]
    with pytest.raises(ConfigError, match="got none"):
        pool([])
    for other in (
        MEMBERS[0].select(torch.tensor([0])),
        mixture(3, 0.1, 0.2, dtype=torch.float32),
        MEMBERS[0].to("meta"),
    ):
        with pytest.raises(ConfigError, match="same shape, dtype and device"):
            pool([MEMBERS[0], other])
