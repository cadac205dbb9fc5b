"""The terrain classifier: from a colour image to class probabilities of every cell that can be trusted.

Any architecture and encoder of segmentation-models-pytorch fits; the default is the U-Net with a
ResNet-18 encoder of paper III-B, joined by the image at full resolution. Cells whose class is not known count neither
in losses nor in measures.

Temperature scaling: one number by which logits are divided, so that confidence fits accuracy. It is fitted to the
validation maps by maximum likelihood and leaves every most likely class as it is. The average of several calibrated
classifiers is not sure enough of itself, the less so the more they differ. So it is given a temperature of its own:
first pool, then calibrate.

Sources: Ronneberger et al. (2015), "U-Net"; He et al. (2016), "Deep residual learning"; Guo et al. (2017), "On
calibration of modern neural networks"; Rahaman and Thiery (2021), "Uncertainty quantification and deep ensembles".
Letters in shapes: B maps, H×W cells, C classes, N cells.
"""

import inspect
import math
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import segmentation_models_pytorch as smp
import timm
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor, nn
from torchmetrics.classification import MulticlassAccuracy, MulticlassJaccardIndex

from benchnav.core import rng
from benchnav.core.device import CPU, exact_convolutions
from benchnav.core.errors import ConfigError, DatasetError, expect, quiet
from benchnav.core.settings import hint, one_line
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.checkpoint import CLASSIFIER, Checkpoint, member_names
from benchnav.models.config import DEEPEST, ClassifierConfig
from benchnav.models.nets.trainable import NO_SCALE, MapScale, TrainableNetwork

_DETAIL_CHANNELS = 32
_CONDITION_SIDE = 64
_MOST_CELLS = 200_000
_LARGEST = 20.0


class MeanIoU(MulticlassJaccardIndex):
    """Intersection over union in the mean over the classes that occur in truth; not a number where none does.

    torchmetrics' own mean counts a class that no cell has as 0 as soon as one cell is taken for it.
    """

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
        super().__init__(
            config,
            accuracy=MulticlassAccuracy(class_count, average="micro", ignore_index=UNLABELLED),
            miou=MeanIoU(class_count, average="none", ignore_index=UNLABELLED),
        )
        # Logits are divided by it once training is over (see `fit_temperature`).
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
        settings = dict(config)
        temperature = settings.pop("temperature", 1.0)
        fits = isinstance(temperature, int | float) and 0 < temperature < math.inf
        expect(fits, f"a `temperature` > 0, got {temperature!r}.")
        model = super().from_tensors(settings, class_count, tensors)
        model.temperature = float(temperature)
        return model


def classifiers_of(checkpoint: Checkpoint) -> list[TerrainClassifier]:
    """Rebuilds the classifiers of a checkpoint, in order.

    Raises:
        CheckpointError: there is none.
    """
    parts, classes = map(checkpoint.part, member_names(checkpoint)), len(checkpoint.class_names)
    return [TerrainClassifier.from_tensors(part.config, classes, part.tensors) for part in parts]


def fit_temperature(logits: Tensor, class_id: Tensor) -> float:
    """Finds the temperature of least negative log likelihood, in [0.05, 20].

    Args:
        logits: shape [N, C].
        class_id: true classes, int64, shape [N].
    """
    logits = logits.double()

    def loss(log_temperature: float) -> float:
        scaled = logits / float(np.exp(log_temperature))
        return float(nn.functional.cross_entropy(scaled, class_id))

    reach = float(np.log(_LARGEST))
    return float(np.exp(minimize_scalar(loss, bounds=(-reach, reach), method="bounded").x))


def fit_pool_temperature(
    members: Sequence[nn.Module], maps: Any, seed: int = 0, device: torch.device = CPU
) -> float:
    """Finds the temperature of the average of several classifiers' probabilities, for `models.fused.sharpen`.

    Args:
        members: each calibrated by itself, from uint8 images [B, 3, H, W] to logits [B, C, H, W].
        maps: a `models.training.data.MapDataset` with `rgb` and `class_id`.
        seed: root seed of the cells to fit to.
        device: where to compute, to which the classifiers are moved.
    """
    average, class_id = torch.zeros((), device=device), torch.zeros(0, dtype=torch.int64)
    for member in members:
        logits, class_id = sample_logits(member, maps, seed, device)
        average = average + logits.double().softmax(1) / len(members)
    return fit_temperature(average.log(), class_id)


def sample_logits(
    classifier: nn.Module, maps: Any, seed: int = 0, device: torch.device = CPU
) -> tuple[Tensor, Tensor]:
    """Classifies maps and keeps at most 200 000 cells, the same share of every map.

    Args:
        classifier: from uint8 images [B, 3, H, W] to logits [B, C, H, W].
        maps: a `models.training.data.MapDataset` with `rgb` and `class_id`.
        seed: root seed of the draw.
        device: where to compute, to which the classifier is moved.

    Returns:
        Logits [N, C] and true classes [N], int64, of the cells whose class is known, on that device.

    Raises:
        DatasetError: there is no such cell.
    """
    kept = max(1, _MOST_CELLS // len(maps))
    key = rng.stream_key(seed, "models", "temperature")
    found, classifier = [], classifier.to(device)
    with torch.inference_mode(), exact_convolutions():
        for indices, some in maps.chunks(device):
            logits, class_id = classifier(some["rgb"]).float().flatten(2), some["class_id"].flatten(1).long()
            for place, which in enumerate(indices):
                cells = rng.permutation(key, np.array([which]), class_id.shape[1])[0]
                order = torch.from_numpy(cells).to(device)
                drawn = order[class_id[place, order] != UNLABELLED][:kept]
                found.append((logits[place][:, drawn].T.clone(), class_id[place, drawn]))
    logits, class_id = (torch.cat(parts) for parts in zip(*found, strict=True))
    if not len(class_id):
        raise DatasetError("Expected validation maps with cells whose class is known, got none.")
    return logits, class_id


class WithFullResolution(nn.Module):
    """A network whose features are joined by those of the image at full resolution before classes are told.

    Args:
        network: from images [B, 3, H, W] to features [B, 32, H, W].
        class_count: C.
    """

    def __init__(self, network: nn.Module, class_count: int) -> None:
        """Adds a layer beside the network and two behind it."""
        super().__init__()
        self.network = network
        self.detail = _convolution(3, _DETAIL_CHANNELS)
        self.head = nn.Sequential(
            _convolution(2 * _DETAIL_CHANNELS, _DETAIL_CHANNELS), nn.Conv2d(_DETAIL_CHANNELS, class_count, 1)
        )

    def forward(self, image: Tensor) -> Tensor:
        """Computes logits [B, C, H, W] of images [B, 3, H, W]."""
        return self.head(torch.cat([self.network(image), self.detail(image)], dim=1))


@torch.inference_mode(False)  # idle stages are found by gradients, which a caller may have switched off
def build_network(config: ClassifierConfig, class_count: int, seed: int) -> nn.Module:
    """Builds the network with fresh weights; leaves PyTorch's global generator as it was.

    Args:
        config: what it is.
        class_count: C.
        seed: root seed of the weights.

    Returns:
        From images [B, 3, H, W], whose sides are multiples of 2^encoder_depth, to logits [B, C, H, W].

    Raises:
        ConfigError: there is no such architecture or encoder, or they do not take these settings.
    """
    _check_names(config)
    known = inspect.signature(smp.MODEL_ARCHITECTURES_MAPPING[config.architecture]).parameters
    own = known["decoder_channels"].default if "decoder_channels" in known else None
    expect(
        isinstance(own, tuple) or not config.decoder_channels,
        f"no `decoder_channels` for architecture {config.architecture}, which has no such setting, "
        f"got {list(config.decoder_channels)}. Leave them out.",
    )
    # What is not asked for is left to the architecture; at a lesser depth it would have too many channels.
    size: dict[str, Any] = {"decoder_channels": config.decoder_channels} if config.decoder_channels else {}
    if config.encoder_depth < DEEPEST:
        size["encoder_depth"] = config.encoder_depth
        if isinstance(own, tuple):
            size.setdefault("decoder_channels", own[-config.encoder_depth :])
    # The hub's own lines on each trial to reach it would bury the error.
    with torch.random.fork_rng(devices=[]), quiet("huggingface_hub"):
        torch.default_generator.manual_seed(seed)
        try:
            network = smp.create_model(
                config.architecture,
                encoder_name=config.encoder,
                encoder_weights="imagenet" if config.pretrained else None,
                in_channels=3,
                classes=_DETAIL_CHANNELS if config.full_resolution else class_count,
                **size,
            )
            if config.encoder_depth < DEEPEST:
                _drop_unused_stages(network)
        except (OSError, KeyError, RuntimeError) as error:
            if not config.pretrained:
                raise
            raise ConfigError(
                f"Expected to download ImageNet weights of {config.encoder} for `pretrained`, got: {one_line(error)} "
                "Try again where there is a connection, or leave --classifier.pretrained or --mdn.pretrained out."
            ) from error
        except (ValueError, TypeError) as error:
            raise ConfigError(
                f"Expected settings that {config.architecture} of {config.encoder} takes, got `encoder_depth` "
                f"{config.encoder_depth} and `decoder_channels` {list(config.decoder_channels)}: {error} "
                "Change them, or leave them out."
            ) from error
        if config.full_resolution:
            network = WithFullResolution(network, class_count)
    return network.to(memory_format=torch.channels_last)


def _check_names(config: ClassifierConfig) -> None:
    architectures, encoder = smp.MODEL_ARCHITECTURES_MAPPING, config.encoder
    if config.architecture not in architectures:
        near = hint(config.architecture.lower().replace("+", "plus"), architectures)
        raise ConfigError(
            f"Expected `architecture` among {', '.join(architectures)}, got {config.architecture!r}.{near}"
        )
    known, own = list(smp.encoders.get_encoder_names()), encoder.startswith("tu-")
    # Of a name such as tu-resnet18.a1_in1k what follows the dot names weights; one with a colon is on a hub.
    if encoder not in known and not (
        own and (":" in encoder or timm.is_model(encoder[3:].partition(".")[0]))
    ):
        known += [f"tu-{name}" for name in timm.list_models()] if own else []
        raise ConfigError(
            "Expected `encoder` to be one of segmentation-models-pytorch, such as resnet18, or of timm, such as "
            f"tu-resnet18, got {encoder!r}.{hint(encoder, known)}"
        )


def _drop_unused_stages(network: Any) -> None:
    """Takes out what a lesser depth leaves idle in a network's encoder: it would be stored all the same.

    Idle is what has weights of which none is given a gradient.

    Raises:
        ValueError: at this depth the network's answer is not of the image's size.
    """
    answer = network.eval()(torch.zeros(1, 3, _CONDITION_SIDE, _CONDITION_SIDE))
    if answer.shape[-1] != _CONDITION_SIDE:
        raise ValueError(f"it answers {_CONDITION_SIDE} cells with {answer.shape[-1]}.")
    answer.sum().backward()
    for part in list(network.encoder.modules()):
        for name, inner in list(part.named_children()):
            weights = list(inner.parameters())
            if weights and all(weight.grad is None for weight in weights):
                setattr(part, name, nn.Identity())
    network.train().zero_grad()


def _convolution(channels: int, out: int) -> nn.Module:
    return nn.Sequential(nn.Conv2d(channels, out, 3, padding=1, bias=False), nn.BatchNorm2d(out), nn.ReLU())
