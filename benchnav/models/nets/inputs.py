"""Inputs of networks: layers of the maps as the channels of one scaled image.

Letters in shapes: B maps, H×W cells, C channels of a layer, N channels of all inputs.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from benchnav.core.errors import ConfigError, expect
from benchnav.core.grid import is_azimuth
from benchnav.core.settings import hint

# Layers of B maps by name: `rgb` of shape [B, 3, H, W], any other of shape [B, H, W].
Maps = Mapping[str, Tensor]


class LayerScale(NamedTuple):
    """Scale of a layer: statistics of the training maps, float32.

    Args:
        mean: mean of each channel, shape [C]; colours are in 0–255.
        std: standard deviation of each channel, shape [C].
        rms: root mean square of the layer, at least 1, shape [].
    """

    mean: Tensor
    std: Tensor
    rms: Tensor


class InputStack(nn.Module):
    """Layers of maps stacked as the channels of one image, scaled by the training maps.

    Colour has three channels, a direction two (cosine and sine), any other layer one.
    Missing values (NaN) become 0, which represents the mean.

    Args:
        names: names of the layers.
        scale: scale of each layer by name; None if a state dict will be loaded.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, names: Sequence[str], scale: Mapping[str, LayerScale] | None = None
    ) -> None:
        """Register the scale as buffers."""
        super().__init__()
        self.names = tuple(names)
        self.channels = sum(map(_n_channels, names))
        mean = torch.zeros(self.channels)
        std = torch.ones(self.channels)
        if scale is not None:
            mean = torch.cat([scale[name].mean for name in names])
            std = torch.cat([scale[name].std for name in names])
        self.register_buffer("mean", mean.clone())
        self.register_buffer("std", std.clone())

    def forward(self, maps: Maps) -> Tensor:
        """Return the layers of B maps as one image, shape [B, N, H, W]."""
        dtype = self.mean.dtype
        layers = [channels_of(name, maps[name]).to(dtype) for name in self.names]
        image = layers[0] if len(layers) == 1 else torch.cat(layers, 1)
        centred = image - self.mean.view(-1, 1, 1)
        scaled = centred / self.std.view(-1, 1, 1)
        if self.names == ("rgb",):
            return scaled
        return torch.where(scaled.isfinite(), scaled, 0)


def _n_channels(name: str) -> int:
    return 3 if name == "rgb" else 1 + is_azimuth(name)


def channels_of(name: str, layer: Tensor) -> Tensor:
    """Return the channels of a layer of B maps, shape [B, C, H, W]."""
    if name == "rgb":
        return layer
    if is_azimuth(name):
        radians = torch.deg2rad(layer)
        return torch.stack([radians.cos(), radians.sin()], 1)
    return layer.unsqueeze(1)


def check_inputs(inputs: Sequence[str], fields: Iterable[str]) -> None:
    """Check that the maps have all inputs.

    Args:
        inputs: names of the layers that a network receives.
        fields: names of the layers of the maps.

    Raises:
        ConfigError: If `inputs` is empty, names a layer twice, or names a layer that
            the maps do not have.
    """
    options = list(fields)
    is_unique = len(set(inputs)) == len(inputs)
    expect(
        inputs and is_unique,
        f"`inputs` to name at least one map layer, and none twice, got {list(inputs)}.",
    )
    for name in inputs:
        if name not in options:
            raise ConfigError(
                "Expected `inputs` among the layers of the maps "
                f"({', '.join(options)}), got {name!r}.{hint(name, options)}"
            )
