"""Quantile regression: the quantiles of λ at many levels at once, by the pinball loss.

Q is a median and slopes ≥ 0 over normal scores between the levels, so that quantiles
cannot cross, and is clipped to [0, 1]; equal slopes are a Gaussian, with which training
begins. An observed 0 or 1 is learned as −0.1 or 1.1: quantiles of an atom then lie
clearly beyond the range and are clipped to it, which is exact, since clipping is
monotone. No loss
tells the ends of a distribution: of what is beyond the outermost levels half is put on
0 and on 1, so that no observation is impossible.
Sources: Koenker and Bassett (1978), "Regression quantiles"; Powell (1986), "Censored
regression quantiles". Letters in
shapes: B maps, H×W cells, Q inner levels.
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

INNER = LEVELS[1:-1]
_ALL = (0.0, INNER[0] / 2, *INNER, (1 + INNER[-1]) / 2, 1.0)
_MEDIAN = INNER.index(0.5)
_BEYOND = 0.1
_STEPS = (
    torch.special.ndtri(torch.tensor(INNER, dtype=torch.float64))
    .diff()
    .float()
    .view(-1, 1, 1)
)
_FIRST_STD = 0.2


@dataclass(frozen=True, kw_only=True)
class QuantileConfig(JoinedConfig):
    """What the network is and how it is trained."""


class QuantileModel(JoinedModel):
    """Predicts quantiles at the inner levels of `benchnav.core.quantiles`.

    Args:
        config: what it is.
    """

    def __init__(self, config: QuantileConfig) -> None:
        """Keeps the settings."""
        super().__init__(config)

    def first_numbers(self) -> Tensor:
        """A Gaussian of mean 0.5 and standard deviation 0.2."""
        slope = math.log(math.expm1(_FIRST_STD))  # softplus⁻¹
        return torch.cat([torch.full((1,), 0.5), torch.full((len(INNER) - 1,), slope)])

    def to_outputs(self, numbers: Tensor) -> Tensor:
        """Quantiles before clipping, ascending, shape [B, Q, H, W]."""
        rise = (
            nn.functional.softplus(numbers[:, 1:]) * _STEPS.to(numbers.device)
        ).cumsum(1)
        rise = torch.cat([torch.zeros_like(rise[:, :1]), rise], 1)
        return numbers[:, :1] + rise - rise[:, _MEDIAN : _MEDIAN + 1]

    def configure_losses(self) -> Loss:
        """The pinball loss in the mean over the inner levels."""

        def loss(outputs: Tensor, observed: Tensor) -> Tensor:
            beyond = torch.where(
                observed <= 0,
                -_BEYOND,
                torch.where(observed >= 1, 1 + _BEYOND, observed),
            )
            return pinball(outputs, INNER, beyond)

        return loss

    def to_distribution(self, outputs: Tensor) -> QuantileDistribution:
        """Piecewise linear between the quantiles, which are clipped to [0, 1]."""
        inside = outputs.clamp(0, 1)
        none, whole = torch.zeros_like(inside[:, :2]), torch.ones_like(inside[:, :2])
        return QuantileDistribution(torch.cat([none, inside, whole], 1), _ALL)

    def sharpen(
        self, distribution: TraversabilityDistribution
    ) -> TraversabilityDistribution:
        """Applies the temperature T: quantiles at u are those that were at Φ(T·Φ⁻¹(u))."""
        if self.temperature == 1:
            return distribution
        reads = ndtr(self.temperature * ndtri(_ALL))
        return quantiles_at(distribution, reads.tolist(), _ALL)


def pinball(quantiles: Tensor, levels: tuple[float, ...], observed: Tensor) -> Tensor:
    """Pinball loss: max(u e, (u − 1) e) at level u, where e is the observed λ less the
    quantile.

    Args:
        quantiles: shape [B, Q, H, W].
        levels: u of each, Q numbers in (0, 1).
        observed: λ, and NaN where it was not observed, shape [B, H, W].

    Returns:
        Mean over levels and observed cells, a number; 0 where none was.
    """
    seen = observed.isfinite()
    error = torch.where(seen, observed, 0.5).unsqueeze(1) - quantiles
    share = torch.tensor(levels, dtype=quantiles.dtype, device=quantiles.device).view(
        -1, 1, 1
    )
    loss = torch.maximum(share * error, (share - 1) * error).mean(1)
    return torch.where(seen, loss, 0.0).sum() / seen.sum().clamp(min=1)
