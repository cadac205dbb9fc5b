"""The losses and distributions of the zoo against scipy, closed forms and other
libraries.
"""

import math
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.core.pooled import pool
from benchnav.core.quantiles import LEVELS
from benchnav.models.config import JoinedConfig
from benchnav.models.zoo.evidential import EvidentialConfig, evidential_loss
from benchnav.models.zoo.mc_dropout import DropoutConfig
from benchnav.models.zoo.mean_variance import MeanVarianceConfig, beta_nll
from benchnav.models.zoo.quantile import INNER_LEVELS, QuantileModel, pinball
from benchnav.models.zoo.swag import SWAGConfig
from tests.factories import normal
from tests.models.zoo.support import make

OBSERVED = torch.tensor([0.0, 0.05, 0.4, 0.8, 1.0])


@cache
def untrained() -> QuantileModel:
    return make("quantile")


def maps(values: Tensor) -> Tensor:
    """[1, 1, 1, N] of [N]."""
    return values.view(1, 1, 1, -1)


# --- mean and variance ---


@pytest.mark.parametrize("beta", [0.0, 0.5, 1.0])
def test_each_cell_counts_by_the_power_of_its_variance(beta: float) -> None:
    means, stds = (
        torch.tensor([0.1, 0.0, 0.5, 0.6, 1.1]),
        torch.tensor([0.1, 0.2, 0.3, 0.1, 0.4]),
    )
    found = beta_nll(maps(means), maps(stds), OBSERVED.view(1, 1, -1), beta)
    law = stats.norm(means.numpy(), stds.numpy())
    density = law.logpdf(OBSERVED.numpy())
    # what is clipped to 0 and to 1
    density[0], density[-1] = (
        law.logcdf(0)[0],
        law.logsf(1)[-1],
    )
    assert float(found) == pytest.approx(
        -(density * stds.numpy() ** (2 * beta)).mean(), rel=1e-5
    )


def test_the_power_of_the_variance_has_no_gradient() -> None:
    std = torch.full((1, 1, 1, 1), 0.2, requires_grad=True)
    beta_nll(torch.full_like(std, 0.5), std, torch.full((1, 1, 1), 0.7), 1.0).backward()
    # d/dσ of −log N(0.7; 0.5, σ) is (1 − z²) / σ, which is 0 at z = 1, but for the
    # weight.
    assert std.grad is not None
    assert float(std.grad.abs()) < 1e-6


def test_beta_is_of_training_alone() -> None:
    plain, weighed = make("mean_variance"), make("mean_variance", beta=1.0)
    outputs, observed = (
        (torch.full((1, 1, 2, 2), 0.4), torch.full((1, 1, 2, 2), 0.2)),
        torch.full((1, 2, 2), 0.5),
    )
    assert weighed.loss(outputs, observed) == plain.loss(outputs, observed)
    assert weighed.train().loss(outputs, observed) == pytest.approx(
        float(plain.loss(outputs, observed)) * 0.04
    )


def test_several_gaussians_are_averaged_as_a_pool_is() -> None:
    generator = torch.Generator().manual_seed(0)
    means, stds = (
        torch.rand(1, 3, 2, 5, generator=generator),
        0.1 + torch.rand(1, 3, 2, 5, generator=generator),
    )
    found = make("mean_variance").to_distribution((means, stds))
    pooled = pool([normal(means[:, k], stds[:, k]) for k in range(3)])
    for value in (0.0, 0.3, 0.9):
        torch.testing.assert_close(found.cdf(value), pooled.cdf(value))
    observed = OBSERVED.expand(1, 2, 5)
    torch.testing.assert_close(
        beta_nll(means, stds, observed), -pooled.log_prob(observed).mean()
    )


# --- quantiles ---


@settings(max_examples=50, deadline=None)
@given(
    quantile=st.floats(-0.5, 1.5), observed=st.floats(0, 1), level=st.floats(0.01, 0.99)
)
def test_the_pinball_loss_by_its_definition(
    quantile: float, observed: float, level: float
) -> None:
    found = pinball(
        torch.full((1, 1, 1, 1), quantile), (level,), torch.full((1, 1, 1), observed)
    )
    error = observed - quantile
    assert float(found) == pytest.approx(
        level * error if error > 0 else (level - 1) * error, abs=1e-6
    )


def test_the_pinball_loss_is_least_at_the_quantiles() -> None:
    drawn = np.random.default_rng(0).beta(2, 5, 20_001)
    right = torch.from_numpy(np.quantile(drawn, INNER_LEVELS)).float().view(1, -1, 1, 1)
    observed = torch.from_numpy(drawn).float().view(1, 1, -1)

    def loss(quantiles: Tensor) -> float:
        return float(
            pinball(
                quantiles.expand(-1, -1, -1, observed.shape[-1]), INNER_LEVELS, observed
            )
        )

    least = loss(right)
    for place in (0, 20, 35, len(INNER_LEVELS) - 1):
        for off in (-0.02, 0.02):
            other = right.clone()
            other[:, place] += off
            assert loss(other) > least


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 30))
def test_quantiles_never_cross_and_stay_in_range(seed: int, spread: float) -> None:
    network = untrained()
    numbers = spread * torch.randn(
        1, len(INNER_LEVELS), 2, 2, generator=torch.Generator().manual_seed(seed)
    )
    found = network.to_distribution(network.to_outputs(numbers))
    assert found.levels[2:-2] == INNER_LEVELS == LEVELS[1:-1]
    assert bool((found.values.diff(dim=1) >= 0).all())
    assert bool(((found.values >= 0) & (found.values <= 1)).all())


def test_the_median_and_the_slopes_by_hand() -> None:
    network = make("quantile")
    numbers = network.first_numbers().view(1, -1, 1, 1)
    found = network.to_distribution(network.to_outputs(numbers))
    for level in (0.01, 0.2, 0.5, 0.9):
        assert float(found.quantile(level)) == pytest.approx(
            stats.norm.ppf(level, 0.5, 0.2), abs=1e-5
        )
    other = numbers.clone()
    other[:, 0], other[:, 1:] = 0.3, math.log(math.expm1(0.05))
    found = network.to_distribution(network.to_outputs(other))
    for level in (0.01, 0.2, 0.5, 0.9):
        assert float(found.quantile(level)) == pytest.approx(
            stats.norm.ppf(level, 0.3, 0.05), abs=1e-5
        )


def test_an_atom_is_learned_beyond_the_range_and_clipped_to_it() -> None:
    """The pinball loss of λ with atoms at 0 and 1 is least where the clipped quantiles
    are those of λ.
    """
    drawn = torch.from_numpy(
        np.random.default_rng(0).normal(0.8, 0.3, 2_001).clip(0, 1)
    ).float()
    network, observed = make("quantile"), drawn.view(1, 1, -1)
    raw = network.first_numbers().view(1, -1, 1, 1).clone().requires_grad_()
    optimizer = torch.optim.Adam([raw], lr=0.1)
    for step in range(200):
        optimizer.param_groups[0]["lr"] = 0.1 * (1 - step / 200)
        optimizer.zero_grad()
        network.loss(
            network.to_outputs(raw).expand(-1, -1, 1, 2_001), observed
        ).backward()
        optimizer.step()
    found = network.to_distribution(network.to_outputs(raw.detach()))
    for level in (0.02, 0.1, 0.3, 0.5, 0.7):
        assert float(found.quantile(level)) == pytest.approx(
            float(drawn.quantile(level)), abs=0.03
        )
    below, _ = found.cdf_limits(1.0)
    assert float(below) == pytest.approx(float((drawn < 1).float().mean()), abs=0.03)
    assert float(found.cdf(0.0)) == pytest.approx(
        float((drawn == 0).float().mean()), abs=0.01
    )


def test_the_temperature_moves_quantiles_as_normal_scores() -> None:
    network = make("quantile")
    before = network.to_distribution(
        network.to_outputs(network.first_numbers().view(1, -1, 1, 1))
    )
    assert network.sharpen(before) is before
    network.temperature = 2.0
    after = network.sharpen(before)
    for level in (0.05, 0.2, 0.5, 0.9):
        expected = before.quantile(float(stats.norm.cdf(2 * stats.norm.ppf(level))))
        assert float(after.quantile(level)) == pytest.approx(float(expected), abs=2e-3)
    assert float(after.quantile(0.1)) < float(before.quantile(0.1))


def test_no_observation_is_impossible() -> None:
    network = make("quantile")
    found = network.to_distribution(torch.full((1, len(INNER_LEVELS), 1, 1), 0.5))
    below, at = found.cdf_limits(1.0)
    assert float(at - below) == pytest.approx(0.0025)
    assert float(found.cdf(0.0)) == pytest.approx(0.0005)


# --- evidence ---


def evidence(gamma: float, nu: float, alpha: float, beta: float) -> tuple[Tensor, ...]:
    return tuple(torch.full((1, 1, 1, 5), value) for value in (gamma, nu, alpha, beta))


EVIDENCE = [
    (0.6, 1.0, 1.001, 0.05),
    (0.2, 0.3, 2.0, 0.1),
    (0.9, 10.0, 40.0, 1.0),
    (0.4, 2.0, 1.5, 0.001),
]


def student(gamma: float, nu: float, alpha: float, beta: float) -> stats.rv_continuous:
    return stats.t(2 * alpha, gamma, math.sqrt(beta * (1 + nu) / (nu * alpha)))


@pytest.mark.parametrize("values", EVIDENCE)
def test_the_evidential_loss_is_that_of_the_students_t(
    values: tuple[float, float, float, float],
) -> None:
    observed = OBSERVED.view(1, 1, -1)
    found = evidential_loss(evidence(*values), observed, 0.0)  # type: ignore[arg-type]
    assert float(found) == pytest.approx(
        -student(*values).logpdf(OBSERVED.numpy()).mean(), rel=1e-4
    )
    gamma, nu, alpha, _ = values
    more = evidential_loss(evidence(*values), observed, 0.3) - found  # type: ignore[arg-type]
    expected = 0.3 * (OBSERVED - gamma).abs().mean() * (2 * nu + alpha)
    assert float(more) == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.parametrize("values", EVIDENCE)
def test_the_mixture_is_the_students_t_clipped(
    values: tuple[float, float, float, float],
) -> None:
    found = make("evidential").to_distribution(evidence(*values))
    for value in (0.0, 0.01, 0.2, 0.5, 0.8, 0.99, 1 - 1e-6):
        assert float(found.cdf(value)[0, 0, 0]) == pytest.approx(
            student(*values).cdf(value), abs=1.2e-4
        )


def test_the_regulariser_is_the_one_that_was_asked_for() -> None:
    outputs, observed = evidence(0.6, 1.0, 2.0, 0.1), OBSERVED.view(1, 1, -1)
    for weight in (0.0, 0.5):
        found = make("evidential", regulariser=weight).loss(outputs, observed)
        assert found == evidential_loss(outputs, observed, weight)  # type: ignore[arg-type]


def test_evidence_begins_where_it_says() -> None:
    network = make("evidential")
    found = network.to_outputs(network.first_numbers().view(1, -1, 1, 1))
    torch.testing.assert_close(
        torch.cat(found).flatten(),
        torch.tensor([0.5, 1.0, 2.0, 0.1]),
        atol=2e-3,
        rtol=0,
    )


# --- settings ---


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (MeanVarianceConfig, "beta", -0.1),
        (MeanVarianceConfig, "beta", 1.1),
        (EvidentialConfig, "regulariser", -1.0),
        (EvidentialConfig, "regulariser", math.inf),
        (DropoutConfig, "dropout", 1.0),
        (DropoutConfig, "dropout", 0.0),
        (DropoutConfig, "masks", 0),
        (SWAGConfig, "collect", 0.0),
        (SWAGConfig, "collect", 0.9),
        (SWAGConfig, "collect_rate", 0.0),
        (SWAGConfig, "draws", 0),
        (JoinedConfig, "encoder_depth", 6),
        (JoinedConfig, "hidden", 0),
        (JoinedConfig, "inputs", ("slope_deg",)),
    ],
)
def test_settings_that_cannot_train_are_refused(
    kind: type, name: str, value: object
) -> None:
    with pytest.raises(ConfigError, match=name):
        kind(**{name: value})


def test_a_lesser_depth_and_hidden_width_make_a_smaller_network() -> None:
    def size(**changes: int) -> int:
        return sum(
            value.numel() for value in make("mean_variance", **changes).parameters()
        )

    assert size(encoder_depth=2) < size(encoder_depth=3)
    assert size(hidden=8) < size(hidden=16)
    assert make("mean_variance", encoder_depth=3).stride == 8
