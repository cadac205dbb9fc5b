"""The terrain classifier: from colour, and perhaps other layers, to class probabilities
that can be trusted.

Any architecture and encoder of segmentation-models-pytorch fits; the default is the
U-Net with a ResNet-18 encoder of paper III-B, joined by the image at full resolution.
Cells whose class is not known count neither in losses nor in measures.

Sources: Ronneberger et al. (2015), "U-Net"; He et al. (2016), "Deep residual learning".
Letters in shapes: B maps, H×W cells, C classes, N channels of the images that the
network is given.
"""

import inspect
from collections.abc import Mapping, Sequence
from typing import Any, Self

import segmentation_models_pytorch as smp
import timm
import torch
from torch import Tensor, nn
from torchmetrics import Metric
from torchmetrics.classification import MulticlassAccuracy, MulticlassJaccardIndex

from benchnav.core.errors import ConfigError, expect, out_of_memory, quiet
from benchnav.core.settings import hint, one_line
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.checkpoint import CLASSIFIER, Checkpoint, member_names
from benchnav.models.config import DEEPEST, ClassifierConfig
from benchnav.models.nets.calibration import (
    fit_pool_temperature,
    fit_temperature,
    sample_logits,
)
from benchnav.models.nets.inputs import Maps
from benchnav.models.nets.trainable import Loss, TrainableNetwork

_DETAIL_CHANNELS = 32
_CHECK_SIDE = 64  # cells of the side of the map that checks a network
_LEAST_DOUBT = 1e-6


class MeanIoU(MulticlassJaccardIndex):
    """Intersection over union in the mean over the classes that occur in truth; not a
    number where none does.

    torchmetrics' own mean counts a class that no cell has as 0 as soon as one cell is
    taken for it.
    """

    def compute(self) -> Tensor:
        """The mean over all cells so far."""
        return super().compute()[self.confmat.sum(1) > 0].mean()


class TerrainClassifier(TrainableNetwork):
    """Predicts the terrain class of every cell.

    Args:
        config: what it is.
    """

    target = "class_id"

    def __init__(self, config: ClassifierConfig) -> None:
        """Keeps the settings."""
        super().__init__(config)

    @property
    def stride(self) -> int:
        """By which the encoder makes images smaller."""
        return 2**self.config.encoder_depth

    def configure_network(self, channels: int) -> nn.Module:
        """From images to logits of the classes."""
        return build_network(self.config, channels, len(self.map_classes))

    def configure_losses(self) -> Loss:
        """Cross-entropy, a proper score, unless more is asked for.

        A soft Dice loss may be added, which weighs rare classes as much as frequent
        ones. Source: Milletari et al. (2016), "V-Net". The focal loss weighs cells that
        are classified well less than others.
        """
        smoothing, dice, focal = (
            self.config.label_smoothing,
            self.config.dice,
            self.config.focal,
        )
        overlap = smp.losses.DiceLoss("multiclass", ignore_index=UNLABELLED)

        def loss(logits: Tensor, class_id: Tensor) -> Tensor:
            # The mean of PyTorch's own would be 0 / 0 for maps without labels.
            total = nn.functional.cross_entropy(
                logits,
                class_id,
                ignore_index=UNLABELLED,
                label_smoothing=smoothing,
                reduction="none" if focal else "sum",
            )
            if focal:
                total = (total * focal_weights(logits, class_id, focal)).sum()
            loss = total / (class_id != UNLABELLED).sum().clamp(min=1)
            return loss + dice * overlap(logits, class_id) if dice else loss

        return loss

    def configure_metrics(self) -> dict[str, Metric]:
        """Accuracy and mean intersection over union, of the cells whose class is known."""
        count = len(self.map_classes)
        return {
            "accuracy": MulticlassAccuracy(
                count, average="micro", ignore_index=UNLABELLED
            ),
            "miou": MeanIoU(count, average="none", ignore_index=UNLABELLED),
        }

    def update_metrics(self, outputs: Tensor, target: Tensor) -> None:
        """Updates them by the most likely classes."""
        for name in ("accuracy", "miou"):
            self.metrics[name].update(outputs.argmax(1), target)

    def forward(self, maps: Maps) -> Tensor:
        """Computes the logits of the classes.

        Args:
            maps: B maps by field, `inputs` among them.

        Returns:
            Shape [B, C, H, W]; in evaluation divided by the temperature.
        """
        logits = super().forward(maps)
        return logits if self.training else logits / self.temperature

    def calibrate(self, maps: Any, device: torch.device) -> None:
        """Fits the temperature."""
        self.temperature = fit_temperature(
            *sample_logits(self, maps, self.seed, device)
        )

    @classmethod
    def fit_pool(
        cls, members: Sequence[Self], maps: Any, seed: int, device: torch.device
    ) -> float:
        """Fits the temperature of the average of several classifiers' probabilities."""
        return fit_pool_temperature(members, maps, seed, device)

    @classmethod
    def from_tensors(
        cls, config: Mapping[str, Any], map_classes: tuple[str, ...], tensors: Maps
    ) -> Self:
        """As `TrainableNetwork.from_tensors`; in checkpoints before format 2.3 colours
        had a scale of their own.
        """
        renamed = {
            name.replace("colour_", "stack."): value.flatten()
            if name.startswith("colour_")
            else value
            for name, value in tensors.items()
        }
        return super().from_tensors(config, map_classes, renamed)


def focal_weights(logits: Tensor, class_id: Tensor, focal: float) -> Tensor:
    """Weights of cells in the focal loss: (1 − p)^γ, where p is the probability of a
    cell's class.

    Source: Lin et al. (2017), "Focal loss for dense object detection".

    Args:
        logits: shape [B, C, H, W].
        class_id: true classes, int64, 255 where they are not known, shape [B, H, W].
        focal: γ > 0.

    Returns:
        Shape [B, H, W].
    """
    known = torch.where(class_id == UNLABELLED, 0, class_id)
    log_probability = logits.log_softmax(1).gather(1, known.unsqueeze(1)).squeeze(1)
    # At p = 1 a power under 1 would have no gradient.
    return (-torch.expm1(log_probability)).clamp(min=_LEAST_DOUBT) ** focal


def classifiers_of(checkpoint: Checkpoint) -> list[TerrainClassifier]:
    """Rebuilds the classifiers of a checkpoint, in order.

    Raises:
        CheckpointError: there is none.
    """
    parts, names = (
        map(checkpoint.part, member_names(checkpoint, CLASSIFIER)),
        checkpoint.class_names,
    )
    return [
        TerrainClassifier.from_tensors(part.config, names, part.tensors)
        for part in parts
    ]


class WithFullResolution(nn.Module):
    """A network whose features are joined by those of the image at full resolution
    before classes are told.

    Args:
        network: from images [B, N, H, W] to features [B, 32, H, W].
        channels: N.
        class_count: C.
    """

    def __init__(self, network: nn.Module, channels: int, class_count: int) -> None:
        """Adds a layer beside the network and two behind it."""
        super().__init__()
        self.network = network
        self.detail = _convolution(channels, _DETAIL_CHANNELS)
        self.head = nn.Sequential(
            _convolution(2 * _DETAIL_CHANNELS, _DETAIL_CHANNELS),
            nn.Conv2d(_DETAIL_CHANNELS, class_count, 1),
        )

    def forward(self, image: Tensor) -> Tensor:
        """Computes logits [B, C, H, W] of images [B, N, H, W]."""
        return self.head(torch.cat([self.network(image), self.detail(image)], dim=1))


@torch.inference_mode(
    False
)  # idle stages are found by gradients, which a caller may have switched off
def build_network(
    config: ClassifierConfig, channels: int, class_count: int
) -> nn.Module:
    """Builds the network with fresh weights, drawn from PyTorch's global generator.

    Args:
        config: what it is.
        channels: N, of the images.
        class_count: C.

    Returns:
        From images [B, N, H, W], whose sides are multiples of 2^encoder_depth, to
        logits [B, C, H, W].

    Raises:
        ConfigError: there is no such architecture or encoder, or they do not take these
            settings.
    """
    _check_names(config)
    known = inspect.signature(
        smp.MODEL_ARCHITECTURES_MAPPING[config.architecture]
    ).parameters
    own = known["decoder_channels"].default if "decoder_channels" in known else None
    expect(
        isinstance(own, tuple) or not config.decoder_channels,
        f"no `decoder_channels` for architecture {config.architecture}, which has no "
        "such setting, "
        f"got {list(config.decoder_channels)}. Leave them out.",
    )
    # What is not asked for is left to the architecture; at a lesser depth it would have
    # too many channels.
    size: dict[str, Any] = (
        {"decoder_channels": config.decoder_channels} if config.decoder_channels else {}
    )
    if config.encoder_depth < DEEPEST:
        size["encoder_depth"] = config.encoder_depth
        if isinstance(own, tuple):
            size.setdefault("decoder_channels", own[-config.encoder_depth :])
    # The hub's own lines on each trial to reach it would bury the error.
    with quiet("huggingface_hub"):
        try:
            network = smp.create_model(
                config.architecture,
                encoder_name=config.encoder,
                encoder_weights="imagenet" if config.pretrained else None,
                in_channels=channels,
                classes=_DETAIL_CHANNELS if config.full_resolution else class_count,
                **size,
            )
            if config.encoder_depth < DEEPEST:
                _drop_unused_stages(network, channels)
        except (OSError, KeyError, RuntimeError) as error:
            if not config.pretrained:
                raise
            raise out_of_memory(error) or ConfigError(
                f"Expected to download ImageNet weights of {config.encoder} for "
                f"`pretrained`, got: {one_line(error)} "
                "Try again where there is a connection, or leave "
                "--classifier.pretrained or --mdn.pretrained out."
            ) from error
        except (ValueError, TypeError) as error:
            raise ConfigError(
                f"Expected settings that {config.architecture} of {config.encoder} "
                "takes, got `encoder_depth` "
                f"{config.encoder_depth} and `decoder_channels` "
                f"{list(config.decoder_channels)}: {error} "
                "Change them, or leave them out."
            ) from error
        if config.full_resolution:
            network = WithFullResolution(network, channels, class_count)
    return network.to(memory_format=torch.channels_last)


def _check_names(config: ClassifierConfig) -> None:
    architectures, encoder = smp.MODEL_ARCHITECTURES_MAPPING, config.encoder
    if config.architecture not in architectures:
        near = hint(config.architecture.lower().replace("+", "plus"), architectures)
        raise ConfigError(
            f"Expected `architecture` among {', '.join(architectures)}, got "
            f"{config.architecture!r}.{near}"
        )
    known, own = list(smp.encoders.get_encoder_names()), encoder.startswith("tu-")
    # Of a name such as tu-resnet18.a1_in1k what follows the dot names weights. One with
    # a colon, of a hub or a folder, is none: who opens a checkpoint would ask there for
    # it.
    if encoder not in known and not (
        own and timm.is_model(encoder[3:].partition(".")[0])
    ):
        known += [f"tu-{name}" for name in timm.list_models()] if own else []
        raise ConfigError(
            "Expected `encoder` to be one of segmentation-models-pytorch, such as "
            "resnet18, or of timm, such as "
            f"tu-resnet18, got {encoder!r}.{hint(encoder, known)}"
        )


def _drop_unused_stages(network: Any, channels: int) -> None:
    """Takes out what a lesser depth leaves idle in a network's encoder: it would be
    stored all the same.

    Idle is what has weights of which none is given a gradient.

    Raises:
        ValueError: at this depth the network's answer is not of the image's size.
    """
    answer = network.eval()(torch.zeros(1, channels, _CHECK_SIDE, _CHECK_SIDE))
    if answer.shape[-1] != _CHECK_SIDE:
        raise ValueError(f"it answers {_CHECK_SIDE} cells with {answer.shape[-1]}.")
    answer.sum().backward()
    for part in list(network.encoder.modules()):
        for name, inner in list(part.named_children()):
            weights = list(inner.parameters())
            if weights and all(weight.grad is None for weight in weights):
                setattr(part, name, nn.Identity())
    network.train().zero_grad()


def _convolution(channels: int, out: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(channels, out, 3, padding=1, bias=False),
        nn.BatchNorm2d(out),
        nn.ReLU(),
    )
