"""The terrain classifier: from a colour image to class probabilities of every cell.

Any architecture and encoder of segmentation-models-pytorch fits; the default is the U-Net with a
ResNet-18 encoder of paper III-B. Cells whose class is not known count neither in losses nor in measures. Letters
in shapes: B maps, H×W cells, C classes.
"""

import math
from typing import Any, Self

import segmentation_models_pytorch as smp
import torch
from torch import Tensor, nn
from torchmetrics import Metric
from torchmetrics.classification import MulticlassAccuracy, MulticlassJaccardIndex

from benchnav.core.errors import ConfigError
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.checkpoint import CLASSIFIER
from benchnav.models.config import ClassifierConfig
from benchnav.models.nets.network import build_network
from benchnav.models.nets.temperature import fit_temperature, sample_logits
from benchnav.models.nets.trainable import NO_SCALE, MapScale, TrainableNetwork


class MeanIoU(MulticlassJaccardIndex):
    """Intersection over union in the mean over the classes that occur in truth; not a number where none does.

    torchmetrics' own mean counts a class that no cell has as 0 as soon as one cell is taken for it.

    Args:
        class_count: C.
    """

    def __init__(self, class_count: int) -> None:
        """Starts with no cells."""
        super().__init__(class_count, average="none", ignore_index=UNLABELLED)

    def compute(self) -> Tensor:
        """The mean over all cells so far."""
        return super().compute()[self.confmat.sum(1) > 0].mean()


class TerrainClassifier(TrainableNetwork):
    """Predicts the terrain class of every cell from colour.

    Args:
        config: what it is.
        class_count: C.
        scale: of the training maps.
        seed: root seed of the initial weights.
    """

    part, kind = CLASSIFIER, ClassifierConfig
    fields = ("class_id",)
    colour_mean: Tensor
    colour_std: Tensor

    def __init__(
        self, config: ClassifierConfig, class_count: int, scale: MapScale = NO_SCALE, seed: int = 0
    ) -> None:
        """Builds the network with fresh weights."""
        self.class_count = class_count
        super().__init__(config)
        # Logits are divided by it once training is over (see `models.nets.temperature`).
        self.temperature = 1.0
        self.register_buffer("colour_mean", scale.colour_mean.clone().view(3, 1, 1))
        self.register_buffer("colour_std", scale.colour_std.clone().view(3, 1, 1))
        self.network = build_network(config, class_count, seed)

    def loss(self, logits: Tensor, class_id: Tensor) -> Tensor:
        """The training loss: cross-entropy, a proper score, unless more is asked for.

        A soft Dice loss may be added, which weighs rare classes as much as frequent ones. Source: Milletari et al.
        (2016), "V-Net".

        Args:
            logits: shape [B, C, H, W].
            class_id: true classes, shape [B, H, W].

        Returns:
            A number, 0 where no class is known.
        """
        # The mean of PyTorch's own would be 0 / 0 for maps without labels.
        total = nn.functional.cross_entropy(
            logits,
            class_id,
            ignore_index=UNLABELLED,
            label_smoothing=self.config.label_smoothing,
            reduction="sum",
        )
        loss = total / (class_id != UNLABELLED).sum().clamp(min=1)
        if self.config.dice:
            overlap = smp.losses.DiceLoss("multiclass", ignore_index=UNLABELLED)
            loss = loss + self.config.dice * overlap(logits, class_id)
        return loss

    def configure_metrics(self) -> dict[str, Metric]:
        """Share of the labelled cells that are right, and mean intersection over union."""
        return {
            "accuracy": MulticlassAccuracy(self.class_count, average="micro", ignore_index=UNLABELLED),
            "miou": MeanIoU(self.class_count),
        }

    def settings(self) -> dict[str, Any]:
        """The configuration and the temperature."""
        return {**super().settings(), "temperature": self.temperature}

    def forward(self, rgb: Tensor) -> Tensor:
        """Computes the logits of the classes; maps of any size are padded and the result cropped.

        Args:
            rgb: uint8, shape [B, 3, H, W].

        Returns:
            Shape [B, C, H, W]; in evaluation divided by the temperature.
        """
        height, width = rgb.shape[-2:]
        image = (rgb.to(self.colour_mean.dtype) - self.colour_mean) / self.colour_std
        stride = 2**self.config.encoder_depth
        image = nn.functional.pad(image, (0, -width % stride, 0, -height % stride), mode="replicate")
        logits = self.network(image.contiguous(memory_format=torch.channels_last))
        logits = logits[..., :height, :width]
        return logits if self.training else logits / self.temperature

    def calibrate(self, maps: Any, seed: int, device: torch.device) -> None:
        """Fits the temperature."""
        self.temperature = fit_temperature(*sample_logits(self, maps, seed, device))

    def assess(self, batch: dict[str, Tensor]) -> tuple[Tensor, int]:
        """Computes the loss of a batch, and how many of its cells are labelled; in evaluation updates `metrics`."""
        logits, class_id = self(batch["rgb"]), batch["class_id"].long()
        if not self.training:
            for name in ("accuracy", "miou"):
                self.metrics[name].update(logits.argmax(1), class_id)
        return self.loss(logits, class_id), int((class_id != UNLABELLED).sum())

    @classmethod
    def from_tensors(cls, config: dict[str, Any], class_count: int, tensors: dict[str, Tensor]) -> Self:
        """As `TrainableNetwork.from_tensors`; `config` may have a `temperature` too."""
        settings = {"temperature": 1.0, **config}
        temperature = settings.pop("temperature")
        if not isinstance(temperature, int | float) or not 0 < temperature < math.inf:
            raise ConfigError(f"Expected a `temperature` > 0, got {temperature!r}.")
        model = super().from_tensors(settings, class_count, tensors)
        model.temperature = float(temperature)
        return model
