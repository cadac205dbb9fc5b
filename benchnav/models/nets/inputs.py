"""What networks are given of the maps: layers as the channels of one image, scaled by
the training maps.

Letters in shapes: B maps, H×W cells, N channels of all inputs together.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from benchnav.core.errors import ConfigError, expect
from benchnav.core.grid import is_azimuth
from benchnav.core.settings import hint

# by field, `rgb` of shape [B, 3, H, W], all others [B, H, W]
Maps = Mapping[str, Tensor]


class LayerScale(NamedTuple):
    """What a layer is scaled by: statistics of the training maps, float32.

    Args:
        mean: of each channel, shape [C]; of colours 0–255.
        std: of each channel, shape [C].
        rms: root mean square, at least 1, shape [].
    """

    mean: Tensor
    std: Tensor
    rms: Tensor


class InputStack(nn.Module):
    """Stacks layers of maps as the channels of one image, scaled by the training maps.

    Colour has three channels, a direction two (cosine and sine), any other layer one.
    What is missing, NaN, becomes 0, which stands for the mean.

    Args:
        names: of the layers.
        scale: by layer; where there is none, it comes with the state dict.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, names: Sequence[str], scale: Mapping[str, LayerScale] | None = None
    ) -> None:
        """Keeps the scale as buffers."""
        super().__init__()
        self.names = tuple(names)
        self.channels = sum(
            3 if name == "rgb" else 1 + is_azimuth(name) for name in names
        )
        mean, std = torch.zeros(self.channels), torch.ones(self.channels)
        if scale is not None:
            mean, std = (
                torch.cat([getattr(scale[name], value) for name in names])
                for value in ("mean", "std")
            )
        self.register_buffer("mean", mean.clone())
        self.register_buffer("std", std.clone())

    def forward(self, maps: Maps) -> Tensor:
        """Stacks the layers of B maps; shape [B, N, H, W]."""
        layers = [channels_of(name, maps[name]) for name in self.names]
        image = (
            layers[0]
            if len(layers) == 1
            else torch.cat([layer.to(self.mean.dtype) for layer in layers], 1)
        )
        image = (image.to(self.mean.dtype) - self.mean.view(-1, 1, 1)) / self.std.view(
            -1, 1, 1
        )
        return (
            image if self.names == ("rgb",) else torch.where(image.isfinite(), image, 0)
        )


def channels_of(name: str, layer: Tensor) -> Tensor:
    """The channels of a layer, [B, C, H, W], from a field of the maps."""
    if name == "rgb":
        return layer
    if is_azimuth(name):
        return torch.stack([torch.deg2rad(layer).cos(), torch.deg2rad(layer).sin()], 1)
    return layer.unsqueeze(1)


def check_inputs(inputs: Sequence[str], fields: Iterable[str]) -> None:
    """Refuses inputs that maps do not have.

    Args:
        inputs: layers that a network is to be given.
        fields: layers that the maps have.

    Raises:
        ConfigError: there are none, one is not there, or one stands twice.
    """
    known = list(fields)
    expect(
        inputs and len(set(inputs)) == len(inputs),
        f"`inputs` as layers, each once, got {list(inputs)}.",
    )
    for name in inputs:
        if name not in known:
            raise ConfigError(
                f"Expected `inputs` among the layers of the maps, {', '.join(known)}, "
                f"got {name!r}."
                f"{hint(name, known)}"
            )
