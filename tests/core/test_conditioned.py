"""A distribution given a posterior of its normal score, against draws and the closed
form of one Gaussian.
"""

import math

import numpy as np
import pytest
import torch

from benchnav.core.conditioned import ConditionedDistribution, conditioned, skewed
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from tests.core.distributions import Hidden, mixture, quantiles

SHAPE = (2, 5, 7)
DRAWS = 2_000


def posterior(least: float = 0.2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(9)
    mean = 1.5 * torch.randn(SHAPE, generator=generator, dtype=torch.float64)
    return mean, least + torch.rand(SHAPE, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("skew", [None, 0.0, -0.7, 1.2])
@pytest.mark.parametrize(
    "base", [mixture(3, 0.02, 0.3), quantiles()], ids=["mixture", "quantiles"]
)
def test_it_is_the_distribution_of_scores_that_go_through_the_base(
    base: TraversabilityDistribution, skew: float | None
) -> None:
    mean, std = posterior()
    law = ConditionedDistribution(
        base, mean, std, None if skew is None else torch.full_like(mean, skew)
    )
    # Normal numbers at the middles of equal shares are draws without chance.
    shares = (torch.arange(DRAWS, dtype=torch.float64) + 0.5) / DRAWS
    scores = torch.special.ndtri(shares)
    if skew:
        scores = skewed(scores, torch.tensor(skew, dtype=torch.float64))
    scores = scores.repeat_interleave(2).view(-1, 1, 1)
    many = torch.arange(2).repeat(DRAWS)
    draws = (
        base.select(many)
        .from_normal(mean[many] + std[many] * scores)
        .view(DRAWS, *SHAPE)
    )
    torch.testing.assert_close(law.mean(), draws.mean(0), rtol=0, atol=1e-3)
    torch.testing.assert_close(
        law.cvar(0.9), draws[: DRAWS // 10].mean(0), rtol=0, atol=2e-3
    )
    torch.testing.assert_close(
        law.expected_time(0.05), (1 / draws.clamp(min=0.05)).mean(0), rtol=5e-3, atol=0
    )
    for value in (0.0, 0.1, 0.45, 0.9, 1.0):
        torch.testing.assert_close(
            law.cdf(value), (draws <= value).double().mean(0), rtol=0, atol=1e-3
        )
        torch.testing.assert_close(
            law.chance(value), (draws >= value).double().mean(0), rtol=0, atol=1e-3
        )
    for place in (40, 1000, DRAWS - 1):
        torch.testing.assert_close(
            law.quantile(float(shares[place])), draws[place], rtol=0, atol=1e-9
        )


@pytest.mark.parametrize("skew", [-1.5, -0.6, -0.01, 0.0, 0.002, 0.3, 1.4])
def test_a_skew_number_has_mean_0_variance_1_and_its_skewness(skew: float) -> None:
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    found = skewed(torch.from_numpy(nodes), torch.tensor(skew)).numpy()
    for power, moment in ((1, 0.0), (2, 1.0), (3, skew)):
        assert (weights * found**power).sum() / weights.sum() == pytest.approx(
            moment, abs=2e-3
        )
    assert (np.diff(found) > 0).all()


def test_without_news_it_is_the_base() -> None:
    base, observed = mixture(3, 0.02, 0.3), torch.full(SHAPE, 0.4, dtype=torch.float64)
    law = ConditionedDistribution(
        base, torch.zeros_like(observed), torch.ones_like(observed)
    )
    for name, arguments in (
        ("cdf", (0.3,)), ("quantile", (0.2,)), ("log_prob", (observed,)), ("chance", (0.1,)),
        ("from_normal", (observed,)),
    ):  # fmt: skip
        wanted = getattr(base, name)(*arguments)
        torch.testing.assert_close(
            getattr(law, name)(*arguments), wanted, rtol=0, atol=1e-8
        )


@pytest.mark.parametrize("base", [mixture(1, 0.02, 0.3), mixture(1, 0.2, 0.9)])
def test_of_one_gaussian_it_is_another(base: TraversabilityMixture) -> None:
    mean, std = posterior()
    law, exact = ConditionedDistribution(base, mean, std), conditioned(base, mean, std)
    assert isinstance(exact, TraversabilityMixture)
    assert exact.group == base.group
    torch.testing.assert_close(exact.means, base.means + base.stds * mean.unsqueeze(1))
    torch.testing.assert_close(exact.stds, base.stds * std.unsqueeze(1))
    # Of a Gaussian all is exact, also far out in its tails.
    for value in (0.0, 0.1, 0.5, 0.99, 1.0):
        at = torch.full(SHAPE, value, dtype=torch.float64)
        for found, wanted in zip(
            law.to_normal(value), exact.to_normal(value), strict=True
        ):
            torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(law.cdf(value), exact.cdf(value), rtol=0, atol=1e-12)
        torch.testing.assert_close(
            law.log_prob(at), exact.log_prob(at), rtol=1e-6, atol=1e-6
        )
    for found, wanted in (
        (law.quantile(0.07), exact.quantile(0.07)), (law.cvar(0.9), exact.cvar(0.9)), (law.mean(), exact.mean()),
    ):  # fmt: skip
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)


@pytest.mark.parametrize("skew", [0.0, -0.7, 0.5])
def test_its_density_is_the_slope_of_its_cdf_and_its_atoms_have_their_mass(
    skew: float,
) -> None:
    known = *posterior(0.5), torch.full(SHAPE, skew, dtype=torch.float64)
    law, step = ConditionedDistribution(mixture(3, 0.1, 0.4), *known), 1e-5
    for value in (0.05, 0.4, 0.9):
        slope = (law.cdf(value + step) - law.cdf(value - step)) / (2 * step)
        found = law.log_prob(torch.full(SHAPE, value, dtype=torch.float64)).exp()
        torch.testing.assert_close(found, slope, rtol=1e-5, atol=1e-8)
    for value, mass in ((0.0, law.cdf(0.0)), (1.0, law.chance(1.0))):
        found = law.log_prob(torch.full(SHAPE, value, dtype=torch.float64)).exp()
        torch.testing.assert_close(found, mass, rtol=1e-6, atol=1e-12)
    assert bool(
        (law.log_prob(torch.full(SHAPE, 1.1, dtype=torch.float64)) == -math.inf).all()
    )
    nothing = ConditionedDistribution(Hidden(law), *posterior()).log_prob(
        torch.full(SHAPE, 0.5)
    )
    assert bool(nothing.isnan().all())


@pytest.mark.parametrize(
    "base", [mixture(3, 0.02, 0.3), mixture(1, 0.02, 0.3), quantiles()]
)
def test_a_score_that_is_known_is_a_point(base: TraversabilityDistribution) -> None:
    mean, _ = posterior()
    law = conditioned(base, mean, torch.zeros_like(mean))
    point = base.from_normal(mean)
    for probability in (0.0, 0.02, 0.5, 0.97):
        found = law.quantile(probability) if probability else law.quantile(1e-9)
        torch.testing.assert_close(found, point, rtol=0, atol=1e-8)
    torch.testing.assert_close(law.mean(), point, rtol=0, atol=1e-4)
    torch.testing.assert_close(law.cvar(0.9), point, rtol=0, atol=1e-4)
    inside = (point > 1e-3) & (point < 1 - 1e-3)
    assert bool((law.cdf(point + 1e-6) > 0.999)[inside].all())
    assert bool((law.cdf(point - 1e-6) < 0.001)[inside].all())


def test_in_float32_a_tail_of_the_base_may_become_the_middle() -> None:
    base = mixture(3, 0.1, 0.3, dtype=torch.float32)
    mean = torch.full(SHAPE, 4.0)
    law = ConditionedDistribution(base, mean, torch.ones_like(mean))
    wide = ConditionedDistribution(
        base._in_float64(), mean.double(), torch.ones_like(mean).double()
    )
    at = law.quantile(0.5)
    assert at.dtype == torch.float32
    inside = at < 1
    assert bool(inside.any())
    torch.testing.assert_close(
        law.cdf(at)[inside].double(),
        torch.full_like(at, 0.5).double()[inside],
        rtol=0,
        atol=1e-4,
    )
    torch.testing.assert_close(law.cdf(0.7).double(), wide.cdf(0.7), rtol=0, atol=1e-6)


def test_scores_of_another_shape_are_refused() -> None:
    base, mean = mixture(3, 0.1, 0.3), torch.zeros(SHAPE)
    for wrong in ((mean[:1], mean), (mean, mean[..., 1:])):
        with pytest.raises(ConfigError, match=r"of the shape of `base` .\[2, 5, 7\]"):
            ConditionedDistribution(base, *wrong)


def test_in_float32_a_narrow_posterior_is_as_in_float64() -> None:
    base, mean = mixture(3, 0.1, 0.3, dtype=torch.float32), torch.full(SHAPE, 2.0)
    law = ConditionedDistribution(base, mean, torch.full_like(mean, 1e-4))
    at = base.from_normal(mean + 5e-5)
    wanted = law._in_float64().cdf(at)
    assert bool(((wanted > 0.05) & (wanted < 0.95)).any())
    torch.testing.assert_close(law.cdf(at).double(), wanted, rtol=0, atol=1e-6)


def test_however_narrow_the_ends_of_its_range_are_those_of_the_base() -> None:
    base = mixture(2, 0.02, 0.3)
    zeros = torch.zeros(SHAPE, dtype=torch.float64)
    law = ConditionedDistribution(base, zeros, zeros + 0.05)
    shares = torch.tensor([0.0, 1.0], dtype=torch.float64).view(2, 1, 1).expand(SHAPE)
    assert torch.equal(law.quantile(0.0), base.quantile(0.0))
    assert torch.equal(law.quantile(1), base.quantile(1.0))
    assert torch.equal(law.quantile(shares), base.quantile(shares))
    point = ConditionedDistribution(base, zeros, zeros)
    assert torch.equal(point.quantile(0.0), point.quantile(0.5))
