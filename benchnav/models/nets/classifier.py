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
from benchnav.core.settings import of, read
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.checkpoint import CLASSIFIER
from benchnav.models.config import ClassifierConfig
from benchnav.models.nets.network import build_network
from benchnav.models.nets.temperature import fit_temperature, sample_logits
from benchnav.models.nets.trainable import TrainableNetwork


class LabelledLoss(nn.Module):
    """Cross-entropy, to which a soft Dice loss may be added, which weighs rare classes as much as frequent ones.

    Source: Milletari et al. (2016), "V-Net".

    Args:
        dice: weight of the Dice loss.
        label_smoothing: of the cross-entropy's targets.
    """

    def __init__(self, dice: float, label_smoothing: float) -> None:
        """Sets the losses up."""
        super().__init__()
        self.dice = dice
        self.cross_entropy = nn.CrossEntropyLoss(
            ignore_index=UNLABELLED, label_smoothing=label_smoothing, reduction="sum"
        )
        self.overlap = smp.losses.DiceLoss("multiclass", ignore_index=UNLABELLED)

    def forward(self, logits: Tensor, class_id: Tensor) -> Tensor:
        """Computes the loss of logits [B, C, H, W] where classes are `class_id` [B, H, W]; 0 where none is known."""
        # The mean of PyTorch's own would be 0 / 0 for maps without labels.
        loss = self.cross_entropy(logits, class_id) / (class_id != UNLABELLED).sum().clamp(min=1)
        return loss + self.dice * self.overlap(logits, class_id) if self.dice else loss


class MeanIoU(MulticlassJaccardIndex):
    """Intersection over union in the mean over the classes that occur in truth; not a number where none does.

    torchmetrics' own mean counts a class that no cell has as 0 as soon as one cell is taken for it.

    Args:
        class_count: C.
        ignore_index: class of the cells that are left out.
    """

    def __init__(self, class_count: int, ignore_index: int | None = None) -> None:
        """Starts with no cells."""
        super().__init__(class_count, average="none", ignore_index=ignore_index)

    def compute(self) -> Tensor:
        """The mean over all cells so far."""
        return super().compute()[self.confmat.sum(1) > 0].mean()


class TerrainClassifier(TrainableNetwork):
    """Predicts the terrain class of every cell from colour.

    Args:
        config: what it is.
        class_count: C.
        colour_mean: of the training maps, 0–255, shape [3].
        colour_std: of the training maps, shape [3].
        seed: root seed of the initial weights.
        temperature: by which logits are divided once training is over (see `models.nets.temperature`).
    """

    part = CLASSIFIER
    fields = ("class_id",)
    colour_mean: Tensor
    colour_std: Tensor

    def __init__(
        self,
        config: ClassifierConfig,
        class_count: int,
        colour_mean: Tensor,
        colour_std: Tensor,
        seed: int = 0,
        temperature: float = 1.0,
    ) -> None:
        """Builds the network with fresh weights."""
        self.class_count = class_count
        super().__init__(config)
        self.temperature = temperature
        self.register_buffer("colour_mean", colour_mean.clone().view(3, 1, 1))
        self.register_buffer("colour_std", colour_std.clone().view(3, 1, 1))
        self.network = self.configure_network(seed)
        self.loss = self.configure_losses()

    @classmethod
    def untrained(cls, config: Any, class_count: int, data: Any = None, seed: int = 0) -> Self:
        """Builds it with fresh weights, for images of the colours of `data`."""
        mean, std = data.colour_statistics() if data else (torch.zeros(3), torch.ones(3))
        return cls(config, class_count, mean, std, seed)

    def configure_network(self, seed: int) -> nn.Module:
        """Builds the network; leaves PyTorch's global generator as it was.

        Raises:
            ConfigError: there is no such architecture or encoder, or they do not take these settings.
        """
        return build_network(self.config, self.class_count, seed)

    def configure_losses(self) -> nn.Module:
        """The training loss: cross-entropy, a proper score, unless more is asked for."""
        return LabelledLoss(self.config.dice, self.config.label_smoothing)

    def configure_metrics(self) -> dict[str, Metric]:
        """Share of the labelled cells that are right, and mean intersection over union."""
        return {
            "accuracy": MulticlassAccuracy(self.class_count, average="micro", ignore_index=UNLABELLED),
            "miou": MeanIoU(self.class_count, ignore_index=UNLABELLED),
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
    def from_tensors(
        cls, config: dict[str, Any], class_count: int, tensors: dict[str, Tensor]
    ) -> "TerrainClassifier":
        """Rebuilds a trained classifier, downloading nothing.

        Args:
            config: fields of `ClassifierConfig`, and `temperature`.
            class_count: C.
            tensors: a state dict.

        Raises:
            ConfigError: the settings are not those of a classifier.
            RuntimeError: the tensors do not fit them.
        """
        settings = {name: value for name, value in config.items() if name != "temperature"}
        built = read(ClassifierConfig, {**settings, "pretrained": False}, of("ClassifierConfig"))
        temperature = config.get("temperature", 1.0)
        if not isinstance(temperature, int | float) or not 0 < temperature < math.inf:
            raise ConfigError(f"Expected a `temperature` > 0, got {temperature!r}.")
        model = cls(built, class_count, torch.zeros(3), torch.ones(3), temperature=float(temperature))
        model.load_state_dict(tensors)
        return model.eval()
