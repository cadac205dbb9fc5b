"""A mixture-density network: from colour and slope straight to the distribution of traversability.

It knows no terrain classes: it learns from observed λ alone, by the likelihood of a Gaussian mixture
clipped to [0, 1]. Colour goes through a convolutional network, for what the ground is shows in its
surroundings; slope joins cell by cell, for traversability hangs on the slope of the cell itself.
Sources: Bishop (1994), "Mixture density networks"; Tobin (1958), "Estimation of relationships for
limited dependent variables". Letters in shapes: B maps, H×W cells, K components.
"""

import math
from collections.abc import Mapping
from typing import Any, Self

import torch
from torch import Tensor, nn

from benchnav.core.mixture import TraversabilityMixture, component_log_prob
from benchnav.models.config import ClassifierConfig, MDNConfig
from benchnav.models.nets.classifier import build_network
from benchnav.models.nets.inputs import InputStack, LayerScale, Maps
from benchnav.models.nets.trainable import Loss, TrainableModel

SLOPE = "slope_deg"
LEAST_STD = 0.01

_FIRST_STD, _FIRST_SPREAD = 0.2, 0.1
_FEATURES = 32


def censored_nll(log_weights: Tensor, means: Tensor, stds: Tensor, observed: Tensor) -> Tensor:
    """Negative log likelihood of observed λ under a Gaussian mixture clipped to [0, 1].

    Inside (0, 1) it is that of the density; at 0 and 1 that of the probability mass clipped there.

    Args:
        log_weights: logarithms of weights that sum to 1 over K, shape [B, K, H, W].
        means: before clipping, shape [B, K, H, W].
        stds: before clipping, > 0, shape [B, K, H, W].
        observed: λ in [0, 1], and NaN where it was not observed, shape [B, H, W].

    Returns:
        Mean over the observed cells, a number; 0 where none was.
    """
    seen = observed.isfinite()
    # A cell left out needs some value that is finite: NaN times 0 would reach the gradients.
    at = torch.where(seen, observed, 0.5).unsqueeze(1)
    component = component_log_prob(means, stds, at)
    total = torch.logsumexp(component + log_weights, dim=1)
    return -torch.where(seen, total, 0.0).sum() / seen.sum().clamp(min=1)


class MixtureDensityModel(TrainableModel):
    """Predicts the mixture of every cell from colour and slope.

    Args:
        config: what it is.
    """

    slope_scale_deg: Tensor

    def __init__(self, config: MDNConfig) -> None:
        """Keeps the settings."""
        super().__init__(config)
        # The classifier's network, whose outputs tell of the ground by features rather than by classes.
        self.image = ClassifierConfig(
            architecture=config.architecture, encoder=config.encoder, pretrained=config.pretrained
        )

    @property
    def stride(self) -> int:
        """By which the encoder makes images smaller."""
        return 2**self.image.encoder_depth

    def make_modules(self, scale: Mapping[str, LayerScale] | None) -> None:
        """Makes the network of the image, and what joins its features with the slope, where that is an input."""
        self.has_slope = SLOPE in self.inputs
        rms = scale[SLOPE].rms if scale and self.has_slope else torch.ones(())
        self.register_buffer("slope_scale_deg", rms.clone())
        self.stack = InputStack([name for name in self.inputs if name != SLOPE], scale)
        self.network = build_network(self.image, self.stack.channels, _FEATURES)
        count, hidden = self.config.components, self.config.hidden
        torch.default_generator.manual_seed(self.seed)  # so that these weights do not hang on the encoder
        self.joint = nn.Sequential(
            nn.Conv2d(_FEATURES + self.has_slope, hidden, 1),
            nn.SiLU(),
            nn.Conv2d(hidden, hidden, 1),
            nn.SiLU(),
        )
        self.head = nn.Conv2d(hidden, 3 * count, 1)
        self.joint.to(memory_format=torch.channels_last)
        # Components begin with means evenly over [0, 1], and with nearly the same weight and width.
        means = (torch.arange(count) + 0.5) / count
        width = math.log(math.expm1(_FIRST_STD - LEAST_STD))  # softplus⁻¹
        first = torch.cat([torch.zeros(count), means, torch.full((count,), width)])
        self.head.load_state_dict({"weight": _FIRST_SPREAD * self.head.weight, "bias": first})

    def configure_losses(self) -> Loss:
        """The negative log likelihood of λ as observed."""

        def loss(outputs: tuple[Tensor, Tensor, Tensor], observed: Tensor) -> Tensor:
            log_weights, means, stds = outputs
            return censored_nll(log_weights, means, stds, observed)

        return loss

    def forward(self, maps: Maps) -> tuple[Tensor, Tensor, Tensor]:
        """Computes the mixtures of maps of any size; their parameters are float32 under autocast too.

        Args:
            maps: B maps by field, `inputs` among them.

        Returns:
            Logarithms of the weights, means and standard deviations, each of shape [B, K, H, W].
        """
        features = super().forward(maps)
        if self.has_slope:
            slope = (maps[SLOPE].to(self.slope_scale_deg) / self.slope_scale_deg).unsqueeze(1)
            features = torch.cat([features, slope.to(features.dtype)], dim=1)
        hidden = self.joint(features)
        with torch.autocast(hidden.device.type, enabled=False):
            logits, means, widths = self.head(hidden.to(self.head.weight.dtype)).chunk(3, dim=1)
            return logits.log_softmax(1), means, nn.functional.softplus(widths) + LEAST_STD

    def to_distribution(self, outputs: tuple[Tensor, Tensor, Tensor]) -> TraversabilityMixture:
        """The mixture, with parameters of shape [B, K, H, W]."""
        log_weights, means, stds = outputs
        return TraversabilityMixture(log_weights.exp(), means, stds)

    @classmethod
    def from_tensors(cls, config: Mapping[str, Any], map_classes: tuple[str, ...], tensors: Maps) -> Self:
        """As `TrainableModel.from_tensors`; before format 2.3 the network of the image had another name."""
        renamed = {
            name.replace("ground.colour_", "stack.").replace("ground.network.", "network."): (
                value.flatten() if name.startswith("ground.colour_") else value
            )
            for name, value in tensors.items()
        }
        return super().from_tensors(config, map_classes, renamed)
