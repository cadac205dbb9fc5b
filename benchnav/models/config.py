"""Settings of models and of their training; light to import, so that commands start
fast.
"""

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from benchnav.core.command import Device
from benchnav.core.errors import expect

DEEPEST = 5  # stages of the encoders of segmentation-models-pytorch

_MAX_PRIOR = 10  # of λ, which is at most 1; beyond it the GPs cannot be solved
_SEEDS = 2**63  # PyTorch's generators take no others


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """How networks are trained.

    Args:
        seed: Root seed of weights, order and augmentation; members of an ensemble have
            SEED, SEED + 1, ….
        device: Where it is trained and calibrated; auto takes CUDA where there is a
            GPU.
        trainer: Settings of Lightning's trainer, for example --trainer.devices 2
            --trainer.precision 32-true.
        workers: Processes that read maps ahead. The result is the same for any number.
        in_memory: Hold all maps in memory instead of reading them when they are needed.
        half_precision: Store the weights of networks as float16.
        symmetries: Turn and mirror training maps at random; by default all but those
            with a photo, whose light comes from one direction.
        crop: Train on squares of so many cells a side, drawn anew each epoch; 0 takes
            whole maps.
        resume: Go on with an interrupted training from its finished parts and epochs.
        overwrite: Replace an existing checkpoint in `out`, or these parts of it.
        conformal: Recalibrate the model on every second map of valid, which early
            stopping and temperature then leave out. Its lower quantiles then hold on
            new maps of the same kind.
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
    """What training maps are masked by, as a robot that sees what is near would see
    them.

    A masked map is known within a radius of a straight path on it, and that the worse
    the farther from the path.

    Args:
        share: of the maps that are masked, those of valid among them; 0 masks none.
        radius_m: least and greatest radius, between which each map has its own; small
            ones are as frequent as large ones by their logarithm.
        colour_noise: standard deviation of each channel of a colour, 0–255, for each
            metre of distance to the path.
        elevation_noise: standard deviation of elevation in metres, for each metre of
            distance to the path.
    """

    share: float = 0.0
    radius_m: tuple[float, float] = (2.0, 16.0)
    colour_noise: float = 0.5
    elevation_noise: float = 0.002

    def __post_init__(self) -> None:
        """Refuses masks that are none."""
        _check(self, 0 <= self.share <= 1, "share", "in [0, 1]")
        low, high = self.radius_m
        _check(
            self,
            0 < low <= high < math.inf,
            "radius_m",
            "of two radii > 0, ordered and finite",
        )
        for name in ("colour_noise", "elevation_noise"):
            _check(self, 0 <= getattr(self, name) < math.inf, name, "≥ 0 and finite")


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """What any trainable model is given, and how it is trained; a model of one's own
    adds its own settings.

    Args:
        inputs: layers of the maps that the network is given: rgb, elevation_m,
            slope_deg, and others that they have, such as vegetation_m; and seen, 1
            where a cell was seen and 0 elsewhere.
        jitter: largest relative change of brightness, contrast and saturation of a
            training map. At 0 low light stays unseen in training.
        symmetries: turn and mirror training maps at random. Maps with a photo, whose
            light comes from one direction, are turned only with `--symmetries true`;
            `--settings.symmetries true` does not turn them.
        crop: cells of a side of the squares that maps are cut to; 0 takes whole maps.
        learning_rate: highest rate of the one-cycle schedule.
        weight_decay: of AdamW.
        batch_size: most maps a batch.
        max_epochs: length of the schedule.
        patience: epochs without a better validation loss after which training stops.
        masking: what of the maps is seen; a network with the input seen is told which
            cells these are.
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
        """Refuses numbers that cannot train."""
        _check(self, 0 < self.learning_rate < 1, "learning_rate", "in (0, 1)")
        for name in ("jitter", "weight_decay"):
            _check(self, 0 <= getattr(self, name) < 1, name, "in [0, 1)")
        _check_least(self, 2, "batch_size")
        _check_least(self, 1, "max_epochs", "patience")


@dataclass(frozen=True, kw_only=True)
class NetworkConfig(TrainingConfig):
    """What a network of segmentation-models-pytorch is and how it is trained.

    Args:
        architecture: a decoder of segmentation-models-pytorch, for example unet, fpn or
            segformer.
        encoder: one of its encoders, for example resnet18.
        pretrained: start from ImageNet weights, which are downloaded; otherwise from
            random ones.
    """

    architecture: str = "unet"
    encoder: str = "resnet18"
    pretrained: bool = False


@dataclass(frozen=True, kw_only=True)
class ClassifierConfig(NetworkConfig):
    """What the classifier is and how it is trained.

    Args:
        encoder_depth: stages of the encoder, each of which halves the image; fewer make
            a smaller network that looks less far around a cell.
        decoder_channels: channels of the decoder's stages, from coarse to fine, as many
            as there are of the encoder's; where none are given, the architecture's own.
        full_resolution: give the last layers the image at full resolution too. Encoders
            begin by halving it, so that without this every class boundary is guessed
            from cells twice as large.
        focal: γ of the focal loss (Lin et al., 2017), which weighs a cell by (1 − p)^γ,
            p the probability of its class; 0 leaves the loss a proper score.
        dice: weight of a soft Dice loss beside the cross-entropy; 0 leaves the loss a
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
        """Refuses numbers that cannot train."""
        super().__post_init__()
        for name in ("focal", "dice"):
            _check(self, 0 <= getattr(self, name) < math.inf, name, "≥ 0")
        _check(self, 0 <= self.label_smoothing < 1, "label_smoothing", "in [0, 1)")
        _check(
            self, 1 <= self.encoder_depth <= DEEPEST, "encoder_depth", f"in 1–{DEEPEST}"
        )
        _check(
            self,
            min(self.decoder_channels, default=1) >= 1,
            "decoder_channels",
            "≥ 1 each",
        )


@dataclass(frozen=True, kw_only=True)
class LatentGPConfig:
    """What the class-wise GPs are and how they are trained.

    The prior decides what is predicted of a class without data, and of slopes steeper
    than any seen.

    Args:
        likelihood: censored, which fits observations clipped to [0, 1], or gaussian.
        second_component: give a class a second mode of λ that slope does not explain,
            where the data show one; with the censored likelihood alone.
        inducing_points: how many, evenly over the slopes of the training data.
        epochs: equal parts of training, after each of which progress is shown.
        epoch_steps: steps an epoch, each over all cells.
        prior_level: λ on flat ground before any data.
        prior_fall: fall of λ per degree of slope before any data.
        prior_fall_std: standard deviation of that fall.
        prior_std: initial standard deviation of the function about this line.
        prior_std_range: range in which training may change it.
        length_deg: initial length scale of the function.
        length_range_deg: range in which training may change it.
        noise_std: standard deviation of λ about the function before any data.
        noise_spread: standard deviation of its logarithm.
        noise_std_range: range in which training may change it.
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
        _check_least(self, 2, "inducing_points")
        _check_least(self, 1, "epochs", "epoch_steps")
        for name in ("prior_level", "prior_fall"):
            _check(
                self, abs(getattr(self, name)) <= _MAX_PRIOR, name, f"in ±{_MAX_PRIOR}"
            )
        for name in ("prior_fall_std", "noise_spread"):
            _check(
                self,
                0 < getattr(self, name) <= _MAX_PRIOR,
                name,
                f"> 0 and at most {_MAX_PRIOR}",
            )
        for name, limits in (
            ("prior_std", "prior_std_range"),
            ("length_deg", "length_range_deg"),
            ("noise_std", "noise_std_range"),
        ):
            low, high = getattr(self, limits)
            fits = 0 < low < getattr(self, name) < high < math.inf
            _check(
                self,
                fits,
                name,
                f"between the bounds of `{limits}`, both > 0, {low} and {high}",
            )


@dataclass(frozen=True, kw_only=True)
class JoinedConfig(NetworkConfig):
    """What a network of the image that slope joins cell by cell is and how it is
    trained.

    Args:
        encoder_depth: stages of the encoder, each of which halves the image; fewer make
            a smaller network that looks less far around a cell.
        hidden: channels of the layers in which slope joins what the image tells of a
            cell.
    """

    encoder_depth: int = 5
    hidden: int = 64
    max_epochs: int = 15

    def __post_init__(self) -> None:
        """Refuses numbers that cannot train."""
        super().__post_init__()
        _check(
            self, 1 <= self.encoder_depth <= DEEPEST, "encoder_depth", f"in 1–{DEEPEST}"
        )
        _check_least(self, 1, "hidden")
        _check(
            self,
            any(name != "slope_deg" for name in self.inputs),
            "inputs",
            "with a layer beside slope_deg",
        )


@dataclass(frozen=True, kw_only=True)
class MDNConfig(JoinedConfig):
    """What the mixture-density network is and how it is trained.

    Args:
        components: K, Gaussians of a cell's mixture.
    """

    components: int = 3

    def __post_init__(self) -> None:
        """Refuses numbers that cannot train."""
        super().__post_init__()
        _check_least(self, 1, "components")


def plain_config(config: Any) -> dict[str, Any]:
    """The settings of a network as plain data; without `masking` where no map is
    masked.

    Args:
        config: a `TrainingConfig`.
    """
    data = asdict(config)
    return {
        name: value
        for name, value in data.items()
        if name != "masking" or config.masking.share
    }


def check_seed(seed: int, count: int = 1) -> None:
    """Refuses a root seed that no generator takes.

    Args:
        seed: the first of the seeds.
        count: how many follow one another.

    Raises:
        ConfigError: one of them is not in 0–2⁶³ − 1.
    """
    expect(0 <= seed <= _SEEDS - count, f"`seed` in 0–{_SEEDS - count}, got {seed}.")


def _check(config: object, fits: bool, name: str, expected: str) -> None:
    expect(fits, f"`{name}` {expected}, got {getattr(config, name)!r}.")


def _check_least(config: object, least: int, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        _check(
            config,
            isinstance(value, int) and value >= least,
            name,
            f"to be an integer ≥ {least}",
        )
