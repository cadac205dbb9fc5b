"""Mean and variance: one Gaussian per cell, clipped to [0, 1], by maximum likelihood.

The likelihood is censored: at 0 and 1 it is the probability mass that is clipped there.
If `beta` is above 0, each cell's gradient is multiplied by σ^(2β), so that training does
not neglect cells with a large variance.
Sources: Nix and Weigend (1994), "Estimating the mean and variance of the target
probability distribution"; Tobin (1958), "Estimation of relationships for limited
dependent variables"; Seitzer et al. (2022), "On the pitfalls of heteroscedastic
uncertainty estimation" (β-NLL). Letters in shapes: B maps, H×W cells, K averaged
Gaussians.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.errors import expect
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.mixture_density import component_log_prob
from benchnav.models.config import JoinedConfig
from benchnav.models.nets.joined import JoinedModel
from benchnav.models.nets.mdn import first_width, to_std
from benchnav.models.nets.trainable import Loss

_FIRST_MEAN = 0.5

# Means and standard deviations before clipping, each of shape [B, K, H, W].
Gaussians = tuple[Tensor, Tensor]


@dataclass(frozen=True, kw_only=True)
class MeanVarianceConfig(JoinedConfig):
    """Settings of the network and its training.

    Args:
        beta: β of the β-NLL, in [0, 1]; at 0 the loss is the plain likelihood, at 1 the
            weight of an error does not depend on the variance.
    """

    beta: float = 0.0

    def __post_init__(self) -> None:
        """Check the ranges of the settings."""
        super().__post_init__()
        expect(0 <= self.beta <= 1, f"`beta` in [0, 1], got {self.beta!r}.")


class MeanVarianceModel(JoinedModel):
    """Model of one Gaussian per cell; subclasses average several with equal weights.

    Args:
        config: settings of the model and its training.
    """

    def __init__(self, config: MeanVarianceConfig) -> None:
        """Store the settings; `build` creates the network."""
        super().__init__(config)

    def first_numbers(self) -> Tensor:
        """Return numbers for a mean of 0.5 and a standard deviation of 0.2."""
        return torch.cat([torch.full((1,), _FIRST_MEAN), first_width(1)])

    def to_outputs(self, numbers: Tensor) -> Gaussians:
        """Return mean and standard deviation, each of shape [B, 1, H, W]."""
        mean, width = numbers.chunk(2, dim=1)
        return mean, to_std(width)

    def configure_losses(self) -> Loss:
        """Return the negative log-likelihood, which training weighs by `beta`.

        Validation uses the plain likelihood, a proper score.
        """

        def loss(outputs: Gaussians, observed: Tensor) -> Tensor:
            beta = self.config.beta if self.training else 0.0
            return beta_nll(*outputs, observed, beta)

        return loss

    def to_distribution(self, outputs: Gaussians) -> TraversabilityMixture:
        """Return the average of the Gaussians, with parameters of shape [B, K, H, W].

        The average equals the result of `core.pooled.pool`.
        """
        means, stds = outputs
        weights = torch.full_like(means, 1 / means.shape[1])
        return TraversabilityMixture(weights, means, stds)


def beta_nll(
    means: Tensor, stds: Tensor, observed: Tensor, beta: float = 0.0
) -> Tensor:
    """Return the censored β-NLL of the average of K clipped Gaussians.

    The negative log-likelihood of each cell is multiplied by σ^(2β).

    Args:
        means: means before clipping, shape [B, K, H, W].
        stds: standard deviations before clipping, > 0, shape [B, K, H, W].
        observed: λ in [0, 1], NaN if not observed, shape [B, H, W].
        beta: β in [0, 1]; σ² is the mean variance over K and has no gradient.

    Returns:
        Mean over the observed cells, a scalar; 0 if no cell is observed.
    """
    has_value = observed.isfinite()
    # Unobserved cells need a finite value: NaN times 0 would enter the gradients.
    finite = torch.where(has_value, observed, 0.5).unsqueeze(1)
    component = component_log_prob(means, stds, finite)
    log_prob = component.logsumexp(1) - math.log(means.shape[1])
    if beta:
        log_prob = log_prob * stds.detach().square().mean(1) ** beta
    return -torch.where(has_value, log_prob, 0.0).sum() / has_value.sum().clamp(min=1)
