"""Quantile regression: the quantiles of λ at many levels at once, by the pinball loss.

Q is a median and slopes ≥ 0 between the levels, so that quantiles cannot cross. The loss sees it before it is clipped
to [0, 1], where what is beyond counts a tenth: quantiles of an atom at 0 or 1 reach it and still have a gradient.
Levels 0 and 1 have the values 0 and 1, since no loss tells the ends of a distribution.
Sources: Koenker and Bassett (1978), "Regression quantiles"; Powell (1986), "Censored regression quantiles". Letters in
shapes: B maps, H×W cells, Q inner levels.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from benchnav.core.quantiles import LEVELS, QuantileDistribution
from benchnav.models.config import JoinedConfig
from benchnav.models.nets.joined import JoinedModel
from benchnav.models.nets.trainable import Loss

INNER = LEVELS[1:-1]
_MEDIAN = INNER.index(0.5)
_LEAK = 0.1
_FIRST_SLOPE = 0.5  # of Q, so that half of [0, 1] is spanned


@dataclass(frozen=True, kw_only=True)
class QuantileConfig(JoinedConfig):
    """What the network is and how it is trained."""


class QuantileModel(JoinedModel):
    """Predicts quantiles at the levels of `benchnav.core.quantiles`.

    Args:
        config: what it is.
    """

    def __init__(self, config: QuantileConfig) -> None:
        """Keeps the settings."""
        super().__init__(config)

    def first_numbers(self) -> Tensor:
        """A median of 0.5, and the same slope everywhere."""
        slope = math.log(math.expm1(_FIRST_SLOPE))  # softplus⁻¹
        return torch.cat([torch.full((1,), 0.5), torch.full((len(INNER) - 1,), slope)])

    def to_outputs(self, numbers: Tensor) -> Tensor:
        """Quantiles before clipping, ascending, shape [B, Q, H, W]."""
        steps = torch.tensor(INNER, device=numbers.device).diff().view(-1, 1, 1)
        rise = (nn.functional.softplus(numbers[:, 1:]) * steps).cumsum(1)
        rise = torch.cat([torch.zeros_like(rise[:, :1]), rise], 1)
        return numbers[:, :1] + rise - rise[:, _MEDIAN : _MEDIAN + 1]

    def configure_losses(self) -> Loss:
        """The pinball loss in the mean over the inner levels."""

        def loss(outputs: Tensor, observed: Tensor) -> Tensor:
            inside = outputs.clamp(0, 1)
            return pinball(inside + _LEAK * (outputs - inside), INNER, observed)

        return loss

    def to_distribution(self, outputs: Tensor) -> QuantileDistribution:
        """Piecewise linear between the quantiles, which are clipped to [0, 1]."""
        inside = outputs.clamp(0, 1)
        ends = torch.zeros_like(inside[:, :1]), torch.ones_like(inside[:, :1])
        return QuantileDistribution(torch.cat([ends[0], inside, ends[1]], 1))


def pinball(quantiles: Tensor, levels: tuple[float, ...], observed: Tensor) -> Tensor:
    """Pinball loss: max(u e, (u − 1) e) at level u, where e is the observed λ less the quantile.

    Args:
        quantiles: shape [B, Q, H, W].
        levels: u of each, Q numbers in (0, 1).
        observed: λ in [0, 1], and NaN where it was not observed, shape [B, H, W].

    Returns:
        Mean over levels and observed cells, a number; 0 where none was.
    """
    seen = observed.isfinite()
    error = torch.where(seen, observed, 0.5).unsqueeze(1) - quantiles
    share = torch.tensor(levels, dtype=quantiles.dtype, device=quantiles.device).view(-1, 1, 1)
    loss = torch.maximum(share * error, (share - 1) * error).mean(1)
    return torch.where(seen, loss, 0.0).sum() / seen.sum().clamp(min=1)
