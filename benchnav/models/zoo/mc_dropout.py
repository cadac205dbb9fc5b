"""Monte Carlo dropout: the average prediction of one network under many dropout masks.

The masks stand for draws from a posterior of the weights. A mask drops the same channels
in all cells of a map, from the image features and from both hidden layers. The masks for
prediction are drawn once from the seed and stored with the weights, so a prediction
depends neither on the batch nor on a generator. The image features are computed once for
all masks.
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
    """Settings of the network and its training.

    Args:
        dropout: probability that a channel is dropped, in (0, 1).
        masks: K, number of masks over which a prediction is averaged, at least 1.
    """

    dropout: float = 0.2
    masks: int = 16

    def __post_init__(self) -> None:
        """Check the ranges of the settings."""
        super().__post_init__()
        expect(0 < self.dropout < 1, f"`dropout` in (0, 1), got {self.dropout!r}.")
        expect(self.masks >= 1, f"`masks` ≥ 1, got {self.masks!r}.")


class DropoutModel(MeanVarianceModel):
    """Model whose prediction is the average over K dropout masks.

    Args:
        config: settings of the model and its training.
    """

    masks: Tensor

    def __init__(self, config: DropoutConfig) -> None:
        """Store the settings; `build` creates the network."""
        super().__init__(config)

    def make_modules(self, scale: Mapping[str, LayerScale] | None) -> None:
        """Create the network and the masks; a mask is a row of the channels of all layers."""
        super().make_modules(scale)
        layers = (*self.joint, self.head)
        self.widths = [
            layer.in_channels for layer in layers if isinstance(layer, nn.Conv2d)
        ]
        key = rng.stream_key(self.seed, "models", "dropout mask")
        indices = np.arange(self.config.masks)
        uniform = rng.uniform(key, indices, (sum(self.widths),))
        self.register_buffer("masks", torch.from_numpy(uniform >= self.config.dropout))

    def forward(self, maps: Maps) -> Gaussians:
        """Compute the outputs, with one new mask per map in training, else with K masks.

        Returns:
            Means and standard deviations, each of shape [B, 1, H, W]; in evaluation mode
            [B, K, H, W].
        """
        features = self.features(maps)
        if self.training:
            size = (len(features), sum(self.widths))
            uniform = torch.rand(size, device=features.device)
            return self._outputs_under(uniform >= self.config.dropout, features)
        outputs = [self._outputs_under(mask[None], features) for mask in self.masks]
        means, stds = zip(*outputs, strict=True)
        return torch.cat(means, 1), torch.cat(stds, 1)

    def _outputs_under(self, masks: Tensor, features: Tensor) -> Gaussians:
        """Return the outputs under masks, bool, shape [B or 1, channels of all layers]."""
        kept_fraction = 1 - self.config.dropout
        first, second, third = (
            mask[..., None, None] / kept_fraction
            for mask in masks.split(self.widths, dim=1)
        )
        hidden = self.joint[:2](features * first.to(features.dtype))
        hidden = self.joint[2:](hidden * second.to(hidden.dtype))
        numbers = self.numbers(hidden * third.to(hidden.dtype))
        return self.to_outputs(numbers)
