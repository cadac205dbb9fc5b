"""Mean and variance: one Gaussian a cell, clipped to [0, 1], by maximum likelihood.

The likelihood is censored: at 0 and 1 it is that of the mass which is clipped there.
With `beta` above 0 each cell's gradient is multiplied by σ^(2β), so that cells of a
large variance are not given up early.
Sources: Nix and Weigend (1994), "Estimating the mean and variance of the target
probability distribution"; Tobin (1958); Seitzer et al. (2022), "On the pitfalls of
heteroscedastic uncertainty estimation" (β-NLL). Letters in shapes: B maps, H×W cells, K
Gaussians that are averaged.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.errors import expect
from benchnav.core.mixture import TraversabilityMixture, component_log_prob
from benchnav.models.config import JoinedConfig
from benchnav.models.nets.joined import JoinedModel
from benchnav.models.nets.mdn import first_width, to_std
from benchnav.models.nets.trainable import Loss

_FIRST_MEAN = 0.5

# means and standard deviations before clipping, each of shape [B, K, H, W]
Gaussians = tuple[Tensor, Tensor]


@dataclass(frozen=True, kw_only=True)
class MeanVarianceConfig(JoinedConfig):
    """What the network is and how it is trained.

    Args:
        beta: β in [0, 1] of the β-NLL; 0 is the plain likelihood, at 1 errors weigh
            alike wherever they are.
    """

    beta: float = 0.0

    def __post_init__(self) -> None:
        """Refuses numbers that cannot train."""
        super().__post_init__()
        expect(0 <= self.beta <= 1, f"`beta` in [0, 1], got {self.beta!r}.")


class MeanVarianceModel(JoinedModel):
    """Predicts one Gaussian a cell; subclasses average several, each as likely as the
    others.

    Args:
        config: what it is.
    """

    def __init__(self, config: MeanVarianceConfig) -> None:
        """Keeps the settings."""
        super().__init__(config)

    def first_numbers(self) -> Tensor:
        """A mean of 0.5 and a standard deviation of 0.2."""
        return torch.cat([torch.full((1,), _FIRST_MEAN), first_width(1)])

    def to_outputs(self, numbers: Tensor) -> Gaussians:
        """The mean and the standard deviation, each of shape [B, 1, H, W]."""
        mean, width = numbers.chunk(2, dim=1)
        return mean, to_std(width)

    def configure_losses(self) -> Loss:
        """The likelihood, in training weighed by `beta`; validation is by the plain
        one, a proper score.
        """

        def loss(outputs: Gaussians, observed: Tensor) -> Tensor:
            return beta_nll(
                *outputs, observed, self.config.beta if self.training else 0.0
            )

        return loss

    def to_distribution(self, outputs: Gaussians) -> TraversabilityMixture:
        """The average of the Gaussians, as `core.pooled.pool` makes it, with parameters
        of shape [B, K, H, W].
        """
        means, stds = outputs
        return TraversabilityMixture(
            torch.full_like(means, 1 / means.shape[1]), means, stds
        )


def beta_nll(
    means: Tensor, stds: Tensor, observed: Tensor, beta: float = 0.0
) -> Tensor:
    """Censored negative log likelihood of the average of K clipped Gaussians, each
    cell's times σ^(2β).

    Args:
        means: before clipping, shape [B, K, H, W].
        stds: before clipping, > 0, shape [B, K, H, W].
        observed: λ in [0, 1], and NaN where it was not observed, shape [B, H, W].
        beta: β; σ² is the mean over K and has no gradient.

    Returns:
        Mean over the observed cells, a number; 0 where none was.
    """
    seen = observed.isfinite()
    # A cell left out needs some value that is finite: NaN times 0 would reach the
    # gradients.
    component = component_log_prob(
        means, stds, torch.where(seen, observed, 0.5).unsqueeze(1)
    )
    total = component.logsumexp(1) - math.log(means.shape[1])
    if beta:
        total = total * stds.detach().square().mean(1) ** beta
    return -torch.where(seen, total, 0.0).sum() / seen.sum().clamp(min=1)
