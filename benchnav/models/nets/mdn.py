"""Mixture density network: a Gaussian mixture of λ per cell from colour and slope.

It does not use terrain classes: it learns only from observed λ, by the likelihood of a
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

from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.mixture_density import component_log_prob
from benchnav.models.config import MDNConfig
from benchnav.models.nets.inputs import Maps
from benchnav.models.nets.joined import JoinedModel
from benchnav.models.nets.trainable import Loss

MIN_STD = 0.01

_FIRST_STD = 0.2


def to_std(widths: Tensor) -> Tensor:
    """Return standard deviations of at least 0.01 from unbounded numbers."""
    return nn.functional.softplus(widths) + MIN_STD


def first_width(count: int) -> Tensor:
    """Return `count` numbers that `to_std` maps to 0.2."""
    width = math.log(math.expm1(_FIRST_STD - MIN_STD))  # softplus⁻¹
    return torch.full((count,), width)


def censored_nll(
    log_weights: Tensor, means: Tensor, stds: Tensor, observed: Tensor
) -> Tensor:
    """Return the censored negative log-likelihood of λ under a clipped mixture.

    The mixture is of Gaussians clipped to [0, 1]. In (0, 1) the likelihood is the
    density; at 0 and 1 it is the probability mass clipped there.

    Args:
        log_weights: logarithms of weights that sum to 1 over K, shape [B, K, H, W].
        means: means before clipping, shape [B, K, H, W].
        stds: standard deviations before clipping, > 0, shape [B, K, H, W].
        observed: λ in [0, 1], NaN if not observed, shape [B, H, W].

    Returns:
        Mean over the observed cells, a scalar; 0 if no cell is observed.
    """
    has_value = observed.isfinite()
    # Unobserved cells need a finite value: NaN times 0 would enter the gradients.
    finite = torch.where(has_value, observed, 0.5).unsqueeze(1)
    component = component_log_prob(means, stds, finite)
    log_prob = torch.logsumexp(component + log_weights, dim=1)
    return -torch.where(has_value, log_prob, 0.0).sum() / has_value.sum().clamp(min=1)


class MixtureDensityModel(JoinedModel):
    """Model that predicts a Gaussian mixture per cell from colour and slope.

    Args:
        config: settings of the model and its training.
    """

    def __init__(self, config: MDNConfig) -> None:
        """Store the settings; `build` creates the network."""
        super().__init__(config)

    def first_numbers(self) -> Tensor:
        """Return numbers for means spread over [0, 1], equal weights and equal widths."""
        count = self.config.components
        logits = torch.zeros(count)
        means = (torch.arange(count) + 0.5) / count
        return torch.cat([logits, means, first_width(count)])

    def configure_losses(self) -> Loss:
        """Return the negative log-likelihood of observed λ."""

        def loss(outputs: tuple[Tensor, Tensor, Tensor], observed: Tensor) -> Tensor:
            log_weights, means, stds = outputs
            return censored_nll(log_weights, means, stds, observed)

        return loss

    def to_outputs(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log weights, means and standard deviations, each of shape [B, K, H, W]."""
        logits, means, widths = numbers.chunk(3, dim=1)
        return logits.log_softmax(1), means, to_std(widths)

    def to_distribution(
        self, outputs: tuple[Tensor, Tensor, Tensor]
    ) -> TraversabilityMixture:
        """Return the mixture, with parameters of shape [B, K, H, W]."""
        log_weights, means, stds = outputs
        return TraversabilityMixture(log_weights.exp(), means, stds)

    @classmethod
    def from_tensors(
        cls, config: Mapping[str, Any], map_classes: tuple[str, ...], tensors: Maps
    ) -> Self:
        """Rebuild a trained network; see `TrainableModel.from_tensors`.

        Checkpoints before format 2.3 have other names for the image network.
        """
        renamed = {}
        for name, values in tensors.items():
            new_name = name.replace("ground.colour_", "stack.")
            new_name = new_name.replace("ground.network.", "network.")
            if name.startswith("ground.colour_"):
                renamed[new_name] = values.flatten()
            else:
                renamed[new_name] = values
        return super().from_tensors(config, map_classes, renamed)
