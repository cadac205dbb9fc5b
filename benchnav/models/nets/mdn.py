"""A mixture-density network: from colour and slope straight to the distribution of
traversability.

It knows no terrain classes: it learns from observed λ alone, by the likelihood of a
Gaussian mixture clipped to [0, 1].
Sources: Bishop (1994), "Mixture density networks"; Tobin (1958), "Estimation of
relationships for limited dependent variables". Letters in shapes: B maps, H×W cells, K
components.
"""

import math
from collections.abc import Mapping
from typing import Any, Self

import torch
from torch import Tensor, nn

from benchnav.core.mixture import TraversabilityMixture, component_log_prob
from benchnav.models.config import MDNConfig
from benchnav.models.nets.inputs import Maps
from benchnav.models.nets.joined import JoinedModel
from benchnav.models.nets.trainable import Loss

LEAST_STD = 0.01

_FIRST_STD = 0.2


def to_std(widths: Tensor) -> Tensor:
    """Standard deviations, at least 0.01, from numbers of any size."""
    return nn.functional.softplus(widths) + LEAST_STD


def first_width(count: int) -> Tensor:
    """So many numbers of which `to_std` makes 0.2."""
    # softplus⁻¹
    return torch.full((count,), math.log(math.expm1(_FIRST_STD - LEAST_STD)))


def censored_nll(
    log_weights: Tensor, means: Tensor, stds: Tensor, observed: Tensor
) -> Tensor:
    """Negative log likelihood of observed λ under a Gaussian mixture clipped to [0, 1].

    Inside (0, 1) it is that of the density; at 0 and 1 that of the probability mass
    clipped there.

    Args:
        log_weights: logarithms of weights that sum to 1 over K, shape [B, K, H, W].
        means: before clipping, shape [B, K, H, W].
        stds: before clipping, > 0, shape [B, K, H, W].
        observed: λ in [0, 1], and NaN where it was not observed, shape [B, H, W].

    Returns:
        Mean over the observed cells, a number; 0 where none was.
    """
    seen = observed.isfinite()
    # A cell left out needs some value that is finite: NaN times 0 would reach the
    # gradients.
    at = torch.where(seen, observed, 0.5).unsqueeze(1)
    component = component_log_prob(means, stds, at)
    total = torch.logsumexp(component + log_weights, dim=1)
    return -torch.where(seen, total, 0.0).sum() / seen.sum().clamp(min=1)


class MixtureDensityModel(JoinedModel):
    """Predicts the mixture of every cell from colour and slope.

    Args:
        config: what it is.
    """

    def __init__(self, config: MDNConfig) -> None:
        """Keeps the settings."""
        super().__init__(config)

    def first_numbers(self) -> Tensor:
        """Components begin with means evenly over [0, 1], and with nearly the same
        weight and width.
        """
        count = self.config.components
        return torch.cat(
            [
                torch.zeros(count),
                (torch.arange(count) + 0.5) / count,
                first_width(count),
            ]
        )

    def configure_losses(self) -> Loss:
        """The negative log likelihood of λ as observed."""

        def loss(outputs: tuple[Tensor, Tensor, Tensor], observed: Tensor) -> Tensor:
            log_weights, means, stds = outputs
            return censored_nll(log_weights, means, stds, observed)

        return loss

    def to_outputs(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logarithms of the weights, means and standard deviations, each of shape [B,
        K, H, W].
        """
        logits, means, widths = numbers.chunk(3, dim=1)
        return logits.log_softmax(1), means, to_std(widths)

    def to_distribution(
        self, outputs: tuple[Tensor, Tensor, Tensor]
    ) -> TraversabilityMixture:
        """The mixture, with parameters of shape [B, K, H, W]."""
        log_weights, means, stds = outputs
        return TraversabilityMixture(log_weights.exp(), means, stds)

    @classmethod
    def from_tensors(
        cls, config: Mapping[str, Any], map_classes: tuple[str, ...], tensors: Maps
    ) -> Self:
        """As `TrainableModel.from_tensors`; before format 2.3 the network of the image
        had another name.
        """
        renamed = {
            name.replace("ground.colour_", "stack.").replace(
                "ground.network.", "network."
            ): (value.flatten() if name.startswith("ground.colour_") else value)
            for name, value in tensors.items()
        }
        return super().from_tensors(config, map_classes, renamed)
