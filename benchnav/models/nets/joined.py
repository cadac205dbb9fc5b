"""From the layers of maps to some numbers a cell: a network of the image, which the
slope joins cell by cell.

The image goes through a convolutional network, for what the ground is shows in its
surroundings; slope joins behind it, for traversability hangs on the slope of the cell
itself. A subclass says what the numbers are.
Letters in shapes: B maps, H×W cells, N numbers a cell, F features a cell.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from benchnav.models.config import ClassifierConfig, JoinedConfig
from benchnav.models.nets.classifier import build_network
from benchnav.models.nets.inputs import InputStack, LayerScale, Maps
from benchnav.models.nets.trainable import TrainableModel

SLOPE = "slope_deg"

_FIRST_SPREAD = 0.1
_FEATURES = 32


class JoinedModel(TrainableModel):
    """Predicts from N numbers a cell, of the image and of the slope where `inputs`
    names it.

    Args:
        config: what it is.
    """

    slope_scale_deg: Tensor

    def __init__(self, config: JoinedConfig) -> None:
        """Keeps the settings."""
        super().__init__(config)
        # The classifier's network, whose outputs tell of the ground by features rather
        # than by classes.
        self.image = ClassifierConfig(
            architecture=config.architecture,
            encoder=config.encoder,
            pretrained=config.pretrained,
            encoder_depth=config.encoder_depth,
        )

    @property
    def stride(self) -> int:
        """By which the encoder makes images smaller."""
        return 2**self.image.encoder_depth

    @abstractmethod
    def first_numbers(self) -> Tensor:
        """What the numbers of a cell are about before any training, shape [N]."""

    @abstractmethod
    def to_outputs(self, numbers: Tensor) -> Any:
        """Gives what the loss and `to_distribution` take, from the numbers, float32 of
        shape [B, N, H, W].
        """

    def make_modules(self, scale: Mapping[str, LayerScale] | None) -> None:
        """Makes the network of the image, and what joins its features with the slope,
        where that is an input.
        """
        self.has_slope = SLOPE in self.inputs
        rms = scale[SLOPE].rms if scale and self.has_slope else torch.ones(())
        self.register_buffer("slope_scale_deg", rms.clone())
        self.stack = InputStack([name for name in self.inputs if name != SLOPE], scale)
        self.network = self.configure_network(self.stack.channels)
        hidden, first = self.config.hidden, self.first_numbers()
        # so that these weights do not hang on the encoder
        torch.default_generator.manual_seed(self.seed)
        self.joint = nn.Sequential(
            nn.Conv2d(_FEATURES + self.has_slope, hidden, 1),
            nn.SiLU(),
            nn.Conv2d(hidden, hidden, 1),
            nn.SiLU(),
        )
        self.head = nn.Conv2d(hidden, len(first), 1)
        self.joint.to(memory_format=torch.channels_last)
        self.head.load_state_dict(
            {"weight": _FIRST_SPREAD * self.head.weight, "bias": first}
        )

    def configure_network(self, channels: int) -> nn.Module:
        """From images to features, [B, F, H, W]."""
        return build_network(self.image, channels, _FEATURES)

    def features(self, maps: Maps) -> Tensor:
        """What the image tells of each cell, and its slope, shape [B, F + 1, H, W]."""
        features = super().forward(maps)
        if self.has_slope:
            slope = (
                maps[SLOPE].to(self.slope_scale_deg) / self.slope_scale_deg
            ).unsqueeze(1)
            features = torch.cat([features, slope.to(features.dtype)], dim=1)
        return features

    def numbers(self, hidden: Tensor) -> Tensor:
        """The numbers of each cell, float32 under autocast too, from the last hidden
        layer.
        """
        with torch.autocast(hidden.device.type, enabled=False):
            return self.head(hidden.to(self.head.weight.dtype))

    def forward(self, maps: Maps) -> Any:
        """Computes the outputs for maps of any size.

        Args:
            maps: B maps by field, `inputs` among them.
        """
        return self.to_outputs(self.numbers(self.joint(self.features(maps))))
