"""Quantile regression: the quantiles of λ at many levels at once, by the pinball loss.

The quantile function is a median plus slopes ≥ 0 over normal scores between the levels,
so that quantiles cannot cross; it is clipped to [0, 1]. Training starts with equal
slopes, which make it Gaussian. Observed 0 and 1 are replaced by the targets −0.1 and 1.1,
so that the quantiles of an atom lie clearly outside [0, 1] before clipping. This is
exact, since clipping is monotone. The loss does not determine the tails: half of the
probability below the lowest level is assigned to 0, and half of that above the highest
level to 1, so that no observation has zero probability.
Sources: Koenker and Bassett (1978), "Regression quantiles"; Powell (1986), "Censored
regression quantiles". Letters in shapes: B maps, H×W cells, Q inner levels.
"""

import math
from dataclasses import dataclass

import torch
from scipy.special import ndtr, ndtri
from torch import Tensor, nn

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.quantiles import LEVELS, QuantileDistribution, quantiles_at
from benchnav.models.config import JoinedConfig
from benchnav.models.nets.joined import JoinedModel
from benchnav.models.nets.trainable import Loss

INNER_LEVELS = LEVELS[1:-1]
_ALL_LEVELS = (0.0, INNER_LEVELS[0] / 2, *INNER_LEVELS, (1 + INNER_LEVELS[-1]) / 2, 1.0)
_MEDIAN_INDEX = INNER_LEVELS.index(0.5)
_TARGET_MARGIN = 0.1
_NORMAL_SCORES = torch.special.ndtri(torch.tensor(INNER_LEVELS, dtype=torch.float64))
_SCORE_STEPS = _NORMAL_SCORES.diff().float().view(-1, 1, 1)
_FIRST_STD = 0.2


@dataclass(frozen=True, kw_only=True)
class QuantileConfig(JoinedConfig):
    """Settings of the network and its training."""


class QuantileModel(JoinedModel):
    """Model that predicts quantiles at the inner levels of `benchnav.core.quantiles`.

    Args:
        config: settings of the model and its training.
    """

    def __init__(self, config: QuantileConfig) -> None:
        """Store the settings; `build` creates the network."""
        super().__init__(config)

    def first_numbers(self) -> Tensor:
        """Return numbers for a Gaussian of mean 0.5 and standard deviation 0.2."""
        slope = math.log(math.expm1(_FIRST_STD))  # softplus⁻¹
        median = torch.full((1,), 0.5)
        return torch.cat([median, torch.full((len(INNER_LEVELS) - 1,), slope)])

    def to_outputs(self, numbers: Tensor) -> Tensor:
        """Return quantiles before clipping, ascending, shape [B, Q, H, W]."""
        slopes = nn.functional.softplus(numbers[:, 1:])
        rise = (slopes * _SCORE_STEPS.to(numbers.device)).cumsum(1)
        rise = torch.cat([torch.zeros_like(rise[:, :1]), rise], 1)
        return numbers[:, :1] + rise - rise[:, _MEDIAN_INDEX : _MEDIAN_INDEX + 1]

    def configure_losses(self) -> Loss:
        """Return the mean pinball loss over the inner levels."""

        def loss(outputs: Tensor, observed: Tensor) -> Tensor:
            upper = torch.where(observed >= 1, 1 + _TARGET_MARGIN, observed)
            target = torch.where(observed <= 0, -_TARGET_MARGIN, upper)
            return pinball(outputs, INNER_LEVELS, target)

        return loss

    def to_distribution(self, outputs: Tensor) -> QuantileDistribution:
        """Return the distribution of the quantiles clipped to [0, 1]."""
        clipped = outputs.clamp(0, 1)
        zeros = torch.zeros_like(clipped[:, :2])
        ones = torch.ones_like(clipped[:, :2])
        return QuantileDistribution(torch.cat([zeros, clipped, ones], 1), _ALL_LEVELS)

    def sharpen(
        self, distribution: TraversabilityDistribution
    ) -> TraversabilityDistribution:
        """Apply the temperature T: the new quantile at u is the old one at Φ(T·Φ⁻¹(u))."""
        if self.temperature == 1:
            return distribution
        old_levels = ndtr(self.temperature * ndtri(_ALL_LEVELS))
        return quantiles_at(distribution, old_levels.tolist(), _ALL_LEVELS)


def pinball(quantiles: Tensor, levels: tuple[float, ...], observed: Tensor) -> Tensor:
    """Return the pinball loss max(u e, (u − 1) e), with e = observed λ − quantile at u.

    Args:
        quantiles: shape [B, Q, H, W].
        levels: level u of each quantile, Q numbers in (0, 1).
        observed: λ, NaN if not observed, shape [B, H, W].

    Returns:
        Mean over levels and observed cells, a scalar; 0 if no cell is observed.
    """
    has_value = observed.isfinite()
    error = torch.where(has_value, observed, 0.5).unsqueeze(1) - quantiles
    level = torch.tensor(levels, dtype=quantiles.dtype, device=quantiles.device)
    level = level.view(-1, 1, 1)
    loss = torch.maximum(level * error, (level - 1) * error).mean(1)
    return torch.where(has_value, loss, 0.0).sum() / has_value.sum().clamp(min=1)
