"""Settings of the two learned halves of a model; light to import, so that commands start fast."""

import math
from dataclasses import dataclass
from typing import Literal

from benchnav.core.errors import ConfigError

DEEPEST = 5  # stages of the encoders of segmentation-models-pytorch

_SEEDS = 2**63  # PyTorch's generators take no others


@dataclass(frozen=True, kw_only=True)
class ClassifierConfig:
    """What the classifier is and how it is trained.

    Args:
        architecture: a decoder of segmentation-models-pytorch, for example unet, fpn or segformer.
        encoder: one of its encoders, for example resnet18.
        encoder_depth: stages of the encoder, each of which halves the image; fewer make a smaller network
            that looks less far around a cell.
        decoder_channels: channels of the decoder's stages, from coarse to fine, as many as there are of the
            encoder's; where none are given, the architecture's own.
        pretrained: start from ImageNet weights, which are downloaded; otherwise from random ones.
        full_resolution: give the last layers the image at full resolution too. Encoders begin by halving
            it, so that without this every class boundary is guessed from cells twice as large.
        dice: weight of a soft Dice loss beside the cross-entropy; 0 leaves the loss a proper score.
        label_smoothing: probability spread over all classes in the targets of the cross-entropy.
        jitter: largest relative change of brightness, contrast and saturation of a training map. At 0
            low light stays unseen in training.
        learning_rate: highest rate of the one-cycle schedule.
        weight_decay: of AdamW.
        batch_size: most maps a batch.
        max_epochs: length of the schedule.
        patience: epochs without a better validation loss after which training stops.
    """

    architecture: str = "unet"
    encoder: str = "resnet18"
    encoder_depth: int = 5
    decoder_channels: tuple[int, ...] = ()
    pretrained: bool = False
    full_resolution: bool = True
    dice: float = 0.0
    label_smoothing: float = 0.0
    jitter: float = 0.0
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    batch_size: int = 16
    max_epochs: int = 20
    patience: int = 10

    def __post_init__(self) -> None:
        """Refuses numbers that cannot train."""
        _check_rate("learning_rate", self.learning_rate)
        if not self.dice >= 0:
            raise ConfigError(f"Expected `dice` ≥ 0, got {self.dice}.")
        for name in ("label_smoothing", "jitter", "weight_decay"):
            _check_share(name, getattr(self, name))
        _check_least(
            encoder_depth=(self.encoder_depth, 1),
            batch_size=(self.batch_size, 2),
            max_epochs=(self.max_epochs, 1),
            patience=(self.patience, 1),
            **{f"decoder_channels[{place}]": (count, 1) for place, count in enumerate(self.decoder_channels)},
        )
        if self.encoder_depth > DEEPEST:
            raise ConfigError(f"Expected `encoder_depth` ≤ {DEEPEST}, got {self.encoder_depth}.")


@dataclass(frozen=True, kw_only=True)
class LatentGPConfig:
    """What the class-wise GPs are and how they are trained.

    The prior decides what is predicted of a class without data, and of slopes steeper than any seen.

    Args:
        likelihood: censored, which fits observations clipped to [0, 1], or gaussian.
        second_component: give a class a second mode of λ that slope does not explain, where the data show
            one; with the censored likelihood alone.
        inducing_points: how many, evenly over the slopes of the training data.
        epochs: equal parts of training, after each of which progress is shown.
        epoch_steps: steps an epoch, each over all cells.
        prior_level: λ on flat ground before any data.
        prior_fall: by which it falls with each degree of slope.
        prior_fall_std: standard deviation of that fall.
        prior_std: standard deviation of the function about this line, to begin with.
        prior_std_range: within which the data may change it.
        length_deg: length scale of the function, to begin with.
        length_range_deg: within which the data may change it.
        noise_std: standard deviation of λ about the function before any data.
        noise_spread: standard deviation of its logarithm.
        noise_std_range: within which the data may change it.
    """

    likelihood: Literal["censored", "gaussian"] = "censored"
    second_component: bool = True
    inducing_points: int = 16
    epochs: int = 4
    epoch_steps: int = 10
    prior_level: float = 0.5
    prior_fall: float = 0.03
    prior_fall_std: float = 0.015
    prior_std: float = 0.5
    prior_std_range: tuple[float, float] = (0.3, 1.0)
    length_deg: float = 8.0
    length_range_deg: tuple[float, float] = (2.0, 10.0)
    noise_std: float = 0.2
    noise_spread: float = 0.5
    noise_std_range: tuple[float, float] = (0.01, 1.0)

    def __post_init__(self) -> None:
        """Refuses settings that cannot train."""
        if self.likelihood not in ("censored", "gaussian"):
            raise ConfigError(f"Expected `likelihood` censored or gaussian, got {self.likelihood!r}.")
        _check_least(
            inducing_points=(self.inducing_points, 2),
            epochs=(self.epochs, 1),
            epoch_steps=(self.epoch_steps, 1),
        )
        for name in ("prior_level", "prior_fall"):
            if not math.isfinite(getattr(self, name)):
                raise ConfigError(f"Expected a finite `{name}`, got {getattr(self, name)}.")
        for name in ("prior_fall_std", "noise_spread"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"Expected `{name}` > 0, got {getattr(self, name)}.")
        for name, limits in (
            ("prior_std", "prior_std_range"),
            ("length_deg", "length_range_deg"),
            ("noise_std", "noise_std_range"),
        ):
            low, high = getattr(self, limits)
            if not 0 < low < getattr(self, name) < high < math.inf:
                raise ConfigError(
                    f"Expected `{name}` between the bounds of `{limits}`, both > 0, "
                    f"got {getattr(self, name)} for {low} to {high}."
                )


@dataclass(frozen=True, kw_only=True)
class MDNConfig:
    """What the mixture-density network is and how it is trained.

    Args:
        components: K, Gaussians of a cell's mixture.
        hidden: channels of the layers in which slope joins what the image tells of a cell.
        architecture: a decoder of segmentation-models-pytorch, for example unet, fpn or segformer.
        encoder: one of its encoders, for example resnet18.
        pretrained: start from ImageNet weights, which are downloaded; otherwise from random ones.
        jitter: largest relative change of brightness, contrast and saturation of a training map.
        learning_rate: highest rate of the one-cycle schedule.
        weight_decay: of AdamW.
        batch_size: most maps a batch.
        max_epochs: length of the schedule.
        patience: epochs without a better validation loss after which training stops.
    """

    components: int = 3
    hidden: int = 64
    architecture: str = "unet"
    encoder: str = "resnet18"
    pretrained: bool = False
    jitter: float = 0.0
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    batch_size: int = 16
    max_epochs: int = 15
    patience: int = 10

    def __post_init__(self) -> None:
        """Refuses numbers that cannot train."""
        _check_rate("learning_rate", self.learning_rate)
        for name in ("jitter", "weight_decay"):
            _check_share(name, getattr(self, name))
        _check_least(
            components=(self.components, 1),
            hidden=(self.hidden, 1),
            batch_size=(self.batch_size, 2),
            max_epochs=(self.max_epochs, 1),
            patience=(self.patience, 1),
        )


def check_seed(seed: int, count: int = 1) -> None:
    """Refuses a root seed that no generator takes.

    Args:
        seed: the first of the seeds.
        count: how many follow one another.

    Raises:
        ConfigError: one of them is not in 0–2⁶³ − 1.
    """
    if not 0 <= seed <= _SEEDS - count:
        raise ConfigError(f"Expected `seed` in 0–{_SEEDS - count}, got {seed}.")


def _check_rate(name: str, value: float) -> None:
    if not 0 < value < 1:
        raise ConfigError(f"Expected `{name}` in (0, 1), got {value}.")


def _check_share(name: str, value: float) -> None:
    if not 0 <= value < 1:
        raise ConfigError(f"Expected `{name}` in [0, 1), got {value}.")


def _check_least(**limits: tuple[int, int]) -> None:
    for name, (value, least) in limits.items():
        if not isinstance(value, int) or value < least:
            raise ConfigError(f"Expected `{name}` to be an integer ≥ {least}, got {value!r}.")
