"""Terrain classifier: calibrated class probabilities from colour and other layers.

It accepts any architecture and encoder of segmentation-models-pytorch. The default is
the U-Net with a ResNet-18 encoder of paper III-B; its last layers also receive features
of the full-resolution image. Losses and metrics ignore unlabelled cells.

Sources: Ronneberger et al. (2015), "U-Net"; He et al. (2016), "Deep residual learning".
Letters in shapes: B maps, H×W cells, C classes, N channels of the network's images.
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

from benchnav.core.errors import ConfigError, expect, out_of_memory_error, quiet
from benchnav.core.settings import hint, one_line
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.checkpoint import Checkpoint, member_names
from benchnav.models.config import MAX_ENCODER_DEPTH, ClassifierConfig
from benchnav.models.nets.calibration import (
    fit_pool_temperature,
    fit_temperature,
    sample_logits,
)
from benchnav.models.nets.inputs import Maps
from benchnav.models.nets.trainable import Loss, TrainableNetwork
from benchnav.models.parts import CLASSIFIER

_DETAIL_CHANNELS = 32  # channels of the features at full resolution
_CHECK_SIDE = 64  # side, in cells, of the map that tests a network
_MIN_ERROR_PROBABILITY = 1e-6


class MeanIoU(MulticlassJaccardIndex):
    """Mean intersection over union of the true classes; NaN if no cell is labelled.

    The mean of torchmetrics counts a class without cells as 0 as soon as one cell is
    predicted as that class.
    """

    def compute(self) -> Tensor:
        """Return the mean over the classes in all cells so far."""
        return super().compute()[self.confmat.sum(1) > 0].mean()


class TerrainClassifier(TrainableNetwork):
    """Network that predicts the terrain class of each cell.

    Args:
        config: settings of the classifier and its training.
    """

    target = "class_id"

    def __init__(self, config: ClassifierConfig) -> None:
        """Store the settings; `build` creates the network."""
        super().__init__(config)

    @property
    def stride(self) -> int:
        """Downsampling factor of the encoder."""
        return 2**self.config.encoder_depth

    def configure_network(self, channels: int) -> nn.Module:
        """Return the network from images to logits of the classes."""
        return build_network(self.config, channels, len(self.map_classes))

    def configure_losses(self) -> Loss:
        """Return the loss: cross-entropy (a proper score), modified by two settings.

        `dice` adds the soft Dice loss, in which rare and frequent classes have the same
        weight. Source: Milletari et al. (2016), "V-Net". `focal` reduces the weight of
        well-classified cells.
        """
        smoothing = self.config.label_smoothing
        dice = self.config.dice
        focal = self.config.focal
        overlap = smp.losses.DiceLoss("multiclass", ignore_index=UNLABELLED)

        def loss(logits: Tensor, class_id: Tensor) -> Tensor:
            # The mean of PyTorch would be 0 / 0 for maps without labels.
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
        """Return accuracy and mean intersection over union of the labelled cells."""
        n_classes = len(self.map_classes)
        return {
            "accuracy": MulticlassAccuracy(
                n_classes, average="micro", ignore_index=UNLABELLED
            ),
            "miou": MeanIoU(n_classes, average="none", ignore_index=UNLABELLED),
        }

    def update_metrics(self, outputs: Tensor, target: Tensor) -> None:
        """Update the metrics with the most likely classes."""
        for name in ("accuracy", "miou"):
            self.metrics[name].update(outputs.argmax(1), target)

    def forward(self, maps: Maps) -> Tensor:
        """Compute the logits of the classes.

        Args:
            maps: layers of B maps by name, including `inputs`.

        Returns:
            Logits of shape [B, C, H, W]; in evaluation mode divided by the temperature.
        """
        logits = super().forward(maps)
        return logits if self.training else logits / self.temperature

    def calibrate(self, maps: Any, device: torch.device) -> None:
        """Fit the temperature."""
        logits, class_id = sample_logits(self, maps, self.seed, device)
        self.temperature = fit_temperature(logits, class_id)

    @classmethod
    def fit_pool(
        cls, members: Sequence[Self], maps: Any, seed: int, device: torch.device
    ) -> float:
        """Fit the temperature of the average of several classifiers' probabilities."""
        return fit_pool_temperature(members, maps, seed, device)

    @classmethod
    def from_tensors(
        cls, config: Mapping[str, Any], map_classes: tuple[str, ...], tensors: Maps
    ) -> Self:
        """Rebuild a trained network; see `TrainableNetwork.from_tensors`.

        Checkpoints before format 2.3 have other names for the scale of colours.
        """
        renamed = {}
        for name, values in tensors.items():
            if name.startswith("colour_"):
                renamed[name.replace("colour_", "stack.")] = values.flatten()
            else:
                renamed[name] = values
        return super().from_tensors(config, map_classes, renamed)


def focal_weights(logits: Tensor, class_id: Tensor, focal: float) -> Tensor:
    """Return the weights (1 − p)^γ of the focal loss, with p the true class's probability.

    Source: Lin et al. (2017), "Focal loss for dense object detection".

    Args:
        logits: shape [B, C, H, W].
        class_id: true classes, int64, 255 if unlabelled, shape [B, H, W].
        focal: γ > 0.

    Returns:
        Weights of shape [B, H, W].
    """
    index = torch.where(class_id == UNLABELLED, 0, class_id).unsqueeze(1)
    log_probability = logits.log_softmax(1).gather(1, index).squeeze(1)
    error_probability = -torch.expm1(log_probability)
    # At p = 1, the gradient of a power below 1 would be infinite.
    return error_probability.clamp(min=_MIN_ERROR_PROBABILITY) ** focal


def classifiers_of(checkpoint: Checkpoint) -> list[TerrainClassifier]:
    """Rebuild the classifiers of a checkpoint, in the order of their part names.

    Raises:
        CheckpointError: If the checkpoint has no classifier.
    """
    class_names = checkpoint.class_names
    classifiers = []
    for name in member_names(checkpoint, CLASSIFIER):
        part = checkpoint.part(name)
        classifier = TerrainClassifier.from_tensors(
            part.config, class_names, part.tensors
        )
        classifiers.append(classifier)
    return classifiers


class WithFullResolution(nn.Module):
    """A network whose last layers also receive features of the full-resolution image.

    Args:
        network: network that returns features [B, 32, H, W] from images [B, N, H, W].
        channels: N, number of channels of the images.
        class_count: C, number of classes.
    """

    def __init__(self, network: nn.Module, channels: int, class_count: int) -> None:
        """Add one layer in parallel with the network and two after it."""
        super().__init__()
        self.network = network
        self.detail = _convolution(channels, _DETAIL_CHANNELS)
        self.head = nn.Sequential(
            _convolution(2 * _DETAIL_CHANNELS, _DETAIL_CHANNELS),
            nn.Conv2d(_DETAIL_CHANNELS, class_count, 1),
        )

    def forward(self, image: Tensor) -> Tensor:
        """Return logits [B, C, H, W] of images [B, N, H, W]."""
        return self.head(torch.cat([self.network(image), self.detail(image)], dim=1))


# Unused stages are detected by gradients, which the caller may have disabled.
@torch.inference_mode(False)
def build_network(
    config: ClassifierConfig, channels: int, class_count: int
) -> nn.Module:
    """Build the network with new weights, drawn from PyTorch's global generator.

    Args:
        config: settings of the classifier.
        channels: N, number of channels of the images.
        class_count: C, number of classes.

    Returns:
        A network that returns logits [B, C, H, W] from images [B, N, H, W], whose sides
        are multiples of 2^encoder_depth.

    Raises:
        ConfigError: If the architecture or encoder does not exist or does not accept
            these settings.
    """
    _check_names(config)
    sizes = _network_sizes(config)
    # The hub's own messages about failed downloads would hide the error.
    with quiet("huggingface_hub"):
        try:
            network = smp.create_model(
                config.architecture,
                encoder_name=config.encoder,
                encoder_weights="imagenet" if config.pretrained else None,
                in_channels=channels,
                classes=_DETAIL_CHANNELS if config.full_resolution else class_count,
                **sizes,
            )
            if config.encoder_depth < MAX_ENCODER_DEPTH:
                _drop_unused_stages(network, channels)
        except (OSError, KeyError, RuntimeError) as error:
            if not config.pretrained:
                raise
            raise out_of_memory_error(error) or ConfigError(
                f"Expected the download of the ImageNet weights of {config.encoder} "
                f"for `pretrained` to succeed, got: {one_line(error).rstrip('.')}. Try "
                "again with a network connection, or leave out `pretrained` "
                "(--classifier.pretrained or --mdn.pretrained)."
            ) from error
        except (ValueError, TypeError) as error:
            raise ConfigError(
                f"Expected settings that {config.architecture} with the encoder "
                f"{config.encoder} accepts, got `encoder_depth` {config.encoder_depth} "
                f"and `decoder_channels` {list(config.decoder_channels)}: "
                f"{str(error).rstrip('.')}. Change these settings, or leave them out."
            ) from error
        if config.full_resolution:
            network = WithFullResolution(network, channels, class_count)
    return network.to(memory_format=torch.channels_last)


def _network_sizes(config: ClassifierConfig) -> dict[str, Any]:
    """Return `encoder_depth` and `decoder_channels` if they differ from the defaults.

    Raises:
        ConfigError: If the architecture has no `decoder_channels`.
    """
    architecture = smp.MODEL_ARCHITECTURES_MAPPING[config.architecture]
    options = inspect.signature(architecture).parameters
    default_channels: Any = None
    if "decoder_channels" in options:
        default_channels = options["decoder_channels"].default
    has_channels = isinstance(default_channels, tuple)
    expect(
        has_channels or not config.decoder_channels,
        f"no `decoder_channels` for the architecture {config.architecture}, got "
        f"{list(config.decoder_channels)}. The architecture has no such setting. Leave "
        "it out.",
    )
    sizes: dict[str, Any] = {}
    if config.decoder_channels:
        sizes["decoder_channels"] = config.decoder_channels
    if config.encoder_depth < MAX_ENCODER_DEPTH:
        sizes["encoder_depth"] = config.encoder_depth
        # The default has one number per stage, which is too many at a lower depth.
        if has_channels and not config.decoder_channels:
            sizes["decoder_channels"] = default_channels[-config.encoder_depth :]
    return sizes


def _check_names(config: ClassifierConfig) -> None:
    """Check that the architecture and the encoder exist.

    Raises:
        ConfigError: If the architecture or the encoder does not exist.
    """
    architectures = smp.MODEL_ARCHITECTURES_MAPPING
    if config.architecture not in architectures:
        spelling = config.architecture.lower().replace("+", "plus")
        raise ConfigError(
            f"Expected `architecture` among {', '.join(architectures)}, got "
            f"{config.architecture!r}.{hint(spelling, architectures)}"
        )
    encoder = config.encoder
    encoders = list(smp.encoders.get_encoder_names())
    if encoder in encoders:
        return
    if encoder.startswith("tu-"):
        # In tu-resnet18.a1_in1k, the suffix after the dot names weights. Names with a
        # colon, such as hf-hub:NAME, are rejected: loading a checkpoint would open them.
        model_name = encoder[3:].partition(".")[0]
        if timm.is_model(model_name):
            return
        encoders += [f"tu-{name}" for name in timm.list_models()]
    raise ConfigError(
        "Expected `encoder` to be an encoder of segmentation-models-pytorch, such as "
        "resnet18, or of timm, such as tu-resnet18, got "
        f"{encoder!r}.{hint(encoder, encoders)}"
    )


def _drop_unused_stages(network: Any, channels: int) -> None:
    """Replace encoder stages that a lower depth does not use; they need not be stored.

    A stage is unused if it has weights and none of them receives a gradient.

    Raises:
        ValueError: If the output at this depth differs in size from the image.
    """
    image = torch.zeros(1, channels, _CHECK_SIDE, _CHECK_SIDE)
    output = network.eval()(image)
    side = output.shape[-1]
    if side != _CHECK_SIDE:
        raise ValueError(f"the output has {side} cells per side, not {_CHECK_SIDE}.")
    output.sum().backward()
    for parent in list(network.encoder.modules()):
        for name, stage in list(parent.named_children()):
            weights = list(stage.parameters())
            if weights and all(weight.grad is None for weight in weights):
                setattr(parent, name, nn.Identity())
    network.train().zero_grad()


def _convolution(in_channels: int, out_channels: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 3, padding=1, bias=False),
        nn.BatchNorm2d(out_channels),
        nn.ReLU(),
    )
