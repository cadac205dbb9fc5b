"""Base of models that predict N numbers per cell, from an image network and slope.

The image passes through a convolutional network, because a cell's surroundings show its
terrain. Slope joins after that network, because traversability depends on the slope of
the cell itself. Subclasses define the meaning of the numbers.
Letters in shapes: B maps, H×W cells, N numbers per cell, F features per cell.
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

_FIRST_WEIGHT_SCALE = 0.1  # factor on the random weights of the last layer
_N_FEATURES = 32


class JoinedModel(TrainableModel):
    """Model that predicts N numbers per cell from the image, and slope if given.

    Args:
        config: settings of the model and its training.
    """

    slope_scale_deg: Tensor

    def __init__(self, config: JoinedConfig) -> None:
        """Derive the settings of the image network."""
        super().__init__(config)
        # The classifier's network, with features instead of classes as outputs.
        self.image_config = ClassifierConfig(
            architecture=config.architecture,
            encoder=config.encoder,
            pretrained=config.pretrained,
            encoder_depth=config.encoder_depth,
        )

    @property
    def stride(self) -> int:
        """Downsampling factor of the encoder."""
        return 2**self.image_config.encoder_depth

    @abstractmethod
    def first_numbers(self) -> Tensor:
        """Return the N numbers of each cell before training, up to small random terms."""

    @abstractmethod
    def to_outputs(self, numbers: Tensor) -> Any:
        """Return the input of the loss and of `to_distribution`.

        Args:
            numbers: float32, shape [B, N, H, W].
        """

    def make_modules(self, scale: Mapping[str, LayerScale] | None) -> None:
        """Create the image network and the layers that join its features with slope."""
        self.has_slope = SLOPE in self.inputs
        rms = scale[SLOPE].rms if scale and self.has_slope else torch.ones(())
        self.register_buffer("slope_scale_deg", rms.clone())
        image_layers = [name for name in self.inputs if name != SLOPE]
        self.stack = InputStack(image_layers, scale)
        self.network = self.configure_network(self.stack.channels)
        hidden = self.config.hidden
        bias = self.first_numbers()
        # Seed again, so that these weights do not depend on the encoder.
        torch.default_generator.manual_seed(self.seed)
        self.joint = nn.Sequential(
            nn.Conv2d(_N_FEATURES + self.has_slope, hidden, 1),
            nn.SiLU(),
            nn.Conv2d(hidden, hidden, 1),
            nn.SiLU(),
        )
        self.head = nn.Conv2d(hidden, len(bias), 1)
        self.joint.to(memory_format=torch.channels_last)
        weight = _FIRST_WEIGHT_SCALE * self.head.weight
        self.head.load_state_dict({"weight": weight, "bias": bias})

    def configure_network(self, channels: int) -> nn.Module:
        """Return the network from images to features, [B, F, H, W]."""
        return build_network(self.image_config, channels, _N_FEATURES)

    def features(self, maps: Maps) -> Tensor:
        """Return the image features of each cell, and its slope, shape [B, F + 1, H, W]."""
        features = super().forward(maps)
        if self.has_slope:
            slope = maps[SLOPE].to(self.slope_scale_deg) / self.slope_scale_deg
            slope = slope.unsqueeze(1).to(features.dtype)
            features = torch.cat([features, slope], dim=1)
        return features

    def numbers(self, hidden: Tensor) -> Tensor:
        """Return the numbers of each cell, float32 even under autocast.

        Args:
            hidden: output of the last hidden layer, [B, hidden channels, H, W].
        """
        with torch.autocast(hidden.device.type, enabled=False):
            return self.head(hidden.to(self.head.weight.dtype))

    def forward(self, maps: Maps) -> Any:
        """Compute the outputs for maps of any size.

        Args:
            maps: layers of B maps by name, including `inputs`.
        """
        return self.to_outputs(self.numbers(self.joint(self.features(maps))))
