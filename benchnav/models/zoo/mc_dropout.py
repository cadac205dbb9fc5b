"""Monte Carlo dropout: one network under many dropout masks, as draws from a posterior
of its weights.

A mask leaves out channels of all cells of a map alike, before each layer behind the
network of the image: the features and both hidden layers. The masks of prediction are
drawn once from the seed and kept with the weights, so that a prediction hangs neither
on the batch nor on a generator; the image's features are computed once for all of them.
Their Gaussians are averaged.
Sources: Gal and Ghahramani (2016), "Dropout as a Bayesian approximation"; Kendall and
Gal (2017), "What uncertainties do we need in Bayesian deep learning for computer
vision?". Letters in shapes: B maps, H×W cells, K masks.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from benchnav.core import rng
from benchnav.core.errors import expect
from benchnav.models.nets.inputs import LayerScale, Maps
from benchnav.models.zoo.mean_variance import (
    Gaussians,
    MeanVarianceConfig,
    MeanVarianceModel,
)


@dataclass(frozen=True, kw_only=True)
class DropoutConfig(MeanVarianceConfig):
    """What the network is and how it is trained.

    Args:
        dropout: probability that a channel is left out.
        masks: K, masks that a prediction averages over.
    """

    dropout: float = 0.2
    masks: int = 16

    def __post_init__(self) -> None:
        """Refuses numbers that cannot train."""
        super().__post_init__()
        expect(0 < self.dropout < 1, f"`dropout` in (0, 1), got {self.dropout!r}.")
        expect(self.masks >= 1, f"`masks` ≥ 1, got {self.masks!r}.")


class DropoutModel(MeanVarianceModel):
    """Predicts the average over dropout masks.

    Args:
        config: what it is.
    """

    masks: Tensor

    def __init__(self, config: DropoutConfig) -> None:
        """Keeps the settings."""
        super().__init__(config)

    def make_modules(self, scale: Mapping[str, LayerScale] | None) -> None:
        """Draws the masks of prediction too, a row each, with the channels of all
        layers in order.
        """
        super().make_modules(scale)
        self.widths = [
            layer.in_channels
            for layer in (*self.joint, self.head)
            if isinstance(layer, nn.Conv2d)
        ]
        key = rng.stream_key(self.seed, "models", "dropout mask")
        drawn = rng.uniform(key, np.arange(self.config.masks), (sum(self.widths),))
        self.register_buffer("masks", torch.from_numpy(drawn >= self.config.dropout))

    def forward(self, maps: Maps) -> Gaussians:
        """Computes the outputs: in training under a mask drawn for each map, in
        evaluation under each of those kept.

        Returns:
            Means and standard deviations, each of shape [B, 1, H, W], in evaluation [B,
            K, H, W].
        """
        features = self.features(maps)
        if self.training:
            drawn = torch.rand(len(features), sum(self.widths), device=features.device)
            return self._under(drawn >= self.config.dropout, features)
        means, stds = zip(
            *(self._under(mask[None], features) for mask in self.masks), strict=True
        )
        return torch.cat(means, 1), torch.cat(stds, 1)

    def _under(self, masks: Tensor, features: Tensor) -> Gaussians:
        """Outputs under masks, bool, shape [B or 1, channels of all layers]."""
        first, second, last = (
            mask[..., None, None] / (1 - self.config.dropout)
            for mask in masks.split(self.widths, dim=1)
        )
        hidden = self.joint[:2](features * first.to(features.dtype))
        hidden = self.joint[2:](hidden * second.to(hidden.dtype))
        return self.to_outputs(self.numbers(hidden * last.to(hidden.dtype)))
