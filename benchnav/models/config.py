"""Settings of models and their training; this module is fast to import, for commands."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from benchnav.core.command import Device
from benchnav.core.errors import expect

MAX_ENCODER_DEPTH = 5  # number of encoder stages in segmentation-models-pytorch

_MAX_PRIOR = 10  # in units of λ; with larger values the GPs cannot be solved
_N_SEEDS = 2**63  # number of valid seeds of PyTorch's generators


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options of the training of networks.

    Args:
        seed: Root seed of weights, map order and augmentation; the members of an ensemble
            have the seeds SEED, SEED + 1, ….
        device: Device for training and calibration; auto uses CUDA if there is a GPU.
        trainer: Settings of Lightning's trainer, for example --trainer.devices 2
            --trainer.precision 32-true.
        workers: Number of processes that read maps ahead. It does not affect the result.
        in_memory: Store all maps in memory instead of reading them on demand.
        half_precision: Store the weights of networks as float16.
        symmetries: Rotate and mirror training maps at random. If not given, this
            applies to all maps except those with a photo, whose light has a fixed
            direction.
        crop: Side in cells of the square cut from each training map, at a new random
            position each epoch; 0 for whole maps.
        resume: Resume an interrupted training from its finished parts and epochs.
        overwrite: Replace an existing checkpoint in `out`, or its parts that are
            trained again.
        conformal: Recalibrate the model on every second map of valid; early stopping and
            temperature then use only the other maps. The lower quantiles then have
            guaranteed coverage on new maps of the same kind.
    """

    seed: int = 0
    device: Device = "auto"
    trainer: dict[str, Any] | None = None
    workers: int = 0
    in_memory: bool = False
    half_precision: bool = True
    symmetries: bool | None = None
    crop: int = 0
    resume: bool = False
    overwrite: bool = False
    conformal: bool = False


@dataclass(frozen=True, kw_only=True)
class Masking:
    """Settings of masks of training maps, which imitate a limited sensor range.

    A masked map is observed within a radius of a straight path, with noise that grows with
    the distance to the path.

    Args:
        share: fraction of the maps that are masked, in train and valid; 0 masks no maps.
        radius_m: minimum and maximum radius in metres; the radius of a map is drawn between
            them, uniformly in its logarithm.
        colour_noise: standard deviation of each channel of a colour, 0–255, per metre of
            distance to the path.
        elevation_noise: standard deviation of elevation in metres, per metre of distance
            to the path.
    """

    share: float = 0.0
    radius_m: tuple[float, float] = (2.0, 16.0)
    colour_noise: float = 0.5
    elevation_noise: float = 0.002

    def __post_init__(self) -> None:
        """Check the ranges of the settings."""
        _check(self, 0 <= self.share <= 1, "share", "in [0, 1]")
        low, high = self.radius_m
        _check(
            self,
            0 < low <= high < math.inf,
            "radius_m",
            "as two finite radii > 0, the smaller first",
        )
        for name in ("colour_noise", "elevation_noise"):
            _check(self, 0 <= getattr(self, name) < math.inf, name, "≥ 0 and finite")


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """Settings of any trainable model and its training; custom models may add settings.

    Args:
        inputs: layers of the maps that the network receives: rgb, elevation_m, slope_deg,
            any other layer of the maps, such as vegetation_m, or seen, which is 1 in
            observed cells and 0 elsewhere.
        jitter: maximum relative change of brightness, contrast and saturation of a training
            map, in [0, 1). At 0, dim light does not occur in training.
        symmetries: rotate and mirror training maps at random. Maps with a photo, whose
            light has a fixed direction, are changed only with `--symmetries true`, not with
            `--settings.symmetries true`.
        crop: side in cells of the squares cut from maps; 0 for whole maps.
        learning_rate: maximum learning rate of the one-cycle schedule, in (0, 1).
        weight_decay: weight decay of AdamW, in [0, 1).
        batch_size: maximum number of maps per batch, at least 2.
        max_epochs: length of the schedule in epochs.
        patience: number of epochs without a lower validation loss after which training
            stops.
        masking: settings of the masks of maps; the input seen contains the masks.
    """

    inputs: tuple[str, ...] = ("rgb", "slope_deg")
    jitter: float = 0.0
    symmetries: bool = True
    crop: int = 0
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    batch_size: int = 16
    max_epochs: int = 20
    patience: int = 10
    masking: Masking = field(default_factory=Masking)

    def __post_init__(self) -> None:
        """Check the ranges of the settings."""
        _check(self, 0 < self.learning_rate < 1, "learning_rate", "in (0, 1)")
        for name in ("jitter", "weight_decay"):
            _check(self, 0 <= getattr(self, name) < 1, name, "in [0, 1)")
        _check_min(self, 2, "batch_size")
        _check_min(self, 1, "max_epochs", "patience")


@dataclass(frozen=True, kw_only=True)
class NetworkConfig(TrainingConfig):
    """Settings of a network of segmentation-models-pytorch and its training.

    Args:
        architecture: a decoder of segmentation-models-pytorch, for example unet, fpn or
            segformer.
        encoder: an encoder of segmentation-models-pytorch, for example resnet18.
        pretrained: start from ImageNet weights, which are downloaded, instead of random
            weights.
    """

    architecture: str = "unet"
    encoder: str = "resnet18"
    pretrained: bool = False


@dataclass(frozen=True, kw_only=True)
class ClassifierConfig(NetworkConfig):
    """Settings of the classifier and its training.

    Args:
        encoder_depth: number of encoder stages, each of which halves the image; fewer
            stages reduce the network and its receptive field.
        decoder_channels: channels of the decoder's stages, from coarse to fine, one per
            encoder stage. If empty, the architecture's defaults.
        full_resolution: pass the image at full resolution to the last layers too. If
            false, class boundaries are predicted at half the resolution, since encoders
            first halve the image.
        focal: γ of the focal loss (Lin et al., 2017), which weighs a cell by (1 − p)^γ,
            with p the probability of its class; at 0 the loss is a proper score.
        dice: weight of a soft Dice loss added to the cross-entropy; at 0 the loss is a
            proper score.
        label_smoothing: probability spread over all classes in the targets of the
            cross-entropy.
    """

    inputs: tuple[str, ...] = ("rgb",)
    encoder_depth: int = 5
    decoder_channels: tuple[int, ...] = ()
    full_resolution: bool = True
    focal: float = 0.0
    dice: float = 0.0
    label_smoothing: float = 0.0

    def __post_init__(self) -> None:
        """Check the ranges of the settings."""
        super().__post_init__()
        for name in ("focal", "dice"):
            _check(self, 0 <= getattr(self, name) < math.inf, name, "≥ 0 and finite")
        _check(self, 0 <= self.label_smoothing < 1, "label_smoothing", "in [0, 1)")
        _check(
            self,
            1 <= self.encoder_depth <= MAX_ENCODER_DEPTH,
            "encoder_depth",
            f"in 1–{MAX_ENCODER_DEPTH}",
        )
        _check(
            self,
            min(self.decoder_channels, default=1) >= 1,
            "decoder_channels",
            "with each value ≥ 1",
        )


@dataclass(frozen=True, kw_only=True)
class LatentGPConfig:
    """Settings of the class-wise GPs and their training.

    The prior determines the prediction for classes without data and for slopes steeper
    than all observed slopes.

    Args:
        likelihood: censored, for observations clipped to [0, 1], or gaussian.
        second_component: fit a second mode of λ, independent of slope, to each class whose
            data have one; only with the censored likelihood.
        inducing_points: number of inducing points, evenly over the slopes of the training
            data.
        epochs: number of equal parts of training, each of which reports progress.
        epoch_steps: number of optimiser steps per epoch, each over all cells.
        prior_level: prior λ on flat terrain.
        prior_fall: prior decrease of λ per degree of slope.
        prior_fall_std: prior standard deviation of this decrease.
        prior_std: initial standard deviation of the GP around the prior line.
        prior_std_range: minimum and maximum of this standard deviation in training.
        length_deg: initial length scale of the GP in degrees.
        length_range_deg: minimum and maximum of the length scale in training, in degrees.
        noise_std: prior standard deviation of λ around the GP.
        noise_spread: prior standard deviation of the logarithm of noise_std.
        noise_std_range: minimum and maximum of noise_std in training.
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
        """Check the ranges of the settings."""
        _check_min(self, 2, "inducing_points")
        _check_min(self, 1, "epochs", "epoch_steps")
        for name in ("prior_level", "prior_fall"):
            is_valid = abs(getattr(self, name)) <= _MAX_PRIOR
            _check(self, is_valid, name, f"in ±{_MAX_PRIOR}")
        for name in ("prior_fall_std", "noise_spread"):
            is_valid = 0 < getattr(self, name) <= _MAX_PRIOR
            _check(self, is_valid, name, f"> 0 and at most {_MAX_PRIOR}")
        for name, limits in (
            ("prior_std", "prior_std_range"),
            ("length_deg", "length_range_deg"),
            ("noise_std", "noise_std_range"),
        ):
            low, high = getattr(self, limits)
            is_valid = 0 < low < getattr(self, name) < high < math.inf
            expected = (
                f"above {low} and below {high}, the finite bounds > 0 in `{limits}`"
            )
            _check(self, is_valid, name, expected)


@dataclass(frozen=True, kw_only=True)
class JoinedConfig(NetworkConfig):
    """Settings of an image network whose last layers receive slope, and its training.

    Args:
        encoder_depth: number of encoder stages, each of which halves the image; fewer
            stages reduce the network and its receptive field.
        hidden: number of channels of the layers that join slope and image features.
    """

    encoder_depth: int = 5
    hidden: int = 64
    max_epochs: int = 15

    def __post_init__(self) -> None:
        """Check the ranges of the settings."""
        super().__post_init__()
        _check(
            self,
            1 <= self.encoder_depth <= MAX_ENCODER_DEPTH,
            "encoder_depth",
            f"in 1–{MAX_ENCODER_DEPTH}",
        )
        _check_min(self, 1, "hidden")
        _check(
            self,
            any(name != "slope_deg" for name in self.inputs),
            "inputs",
            "with a layer other than slope_deg",
        )


@dataclass(frozen=True, kw_only=True)
class MDNConfig(JoinedConfig):
    """Settings of the mixture density network and its training.

    Args:
        components: K, number of Gaussians of a cell's mixture.
    """

    components: int = 3

    def __post_init__(self) -> None:
        """Check the ranges of the settings."""
        super().__post_init__()
        _check_min(self, 1, "components")


def plain_config(config: Any) -> dict[str, Any]:
    """Return the settings of a network as plain data, without `masking` if unused.

    Args:
        config: a `TrainingConfig`.
    """
    settings = asdict(config)
    if not config.masking.share:
        del settings["masking"]
    return settings


def check_seed(seed: int, count: int = 1) -> None:
    """Check that PyTorch's generators accept consecutive seeds.

    Args:
        seed: first seed.
        count: number of seeds.

    Raises:
        ConfigError: If a seed is not in 0–2⁶³ − 1.
    """
    max_seed = _N_SEEDS - count
    expect(0 <= seed <= max_seed, f"`seed` in 0–{max_seed}, got {seed}.")


def _check(config: object, is_valid: bool, name: str, expected: str) -> None:
    expect(is_valid, f"`{name}` {expected}, got {getattr(config, name)!r}.")


def _check_min(config: object, minimum: int, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        is_valid = isinstance(value, int) and value >= minimum
        _check(config, is_valid, name, f"to be an integer ≥ {minimum}")
