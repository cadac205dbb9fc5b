"""The command `benchnav-train`: train models and measure them."""

import sys
from typing import Any

from benchnav.core.command import Command, Device, run
from benchnav.models.config import (
    ClassifierConfig,
    LatentGPConfig,
    MDNConfig,
    TrainOptions,
)
from benchnav.models.onnx_command import export
from benchnav.models.quality.command import compare, evaluate_command

_DEFAULT_CLASSIFIER = ClassifierConfig()
_DEFAULT_GP = LatentGPConfig()
_DEFAULT_MDN = MDNConfig()


def fit(
    options: TrainOptions,
    model: str,
    data: str,
    out: str,
    settings: dict[str, Any] | None = None,
    members: int = 1,
) -> None:
    """Train a model, given by its name or a custom class, or an ensemble of it.

    Args:
        options: Training options.
        model: NAME of a model that can be trained (fused, mdn, mean_variance, quantile,
            evidential, mc_dropout, swag), or path/to/file.py:Class or
            package.module:Class with a TrainableModel.
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder. Logs are written to OUT.training.
        settings: Settings of the model, such as --settings.learning_rate 1e-3
            --settings.inputs [rgb,elevation_m]; for fused, settings of its stages, such as
            --settings.classifier.encoder_depth 3.
        members: Number of networks; their distributions are averaged.
    """
    from benchnav.models.training.networks import fit_model

    fit_model(options, model, data, out, settings or {}, members)


def train_classifier(
    options: TrainOptions,
    data: str,
    out: str,
    classifier: ClassifierConfig = _DEFAULT_CLASSIFIER,
    members: int = 1,
) -> None:
    """Train the terrain classifier, or an ensemble.

    Args:
        options: Training options.
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder; Gaussian processes in it for the same classes are
            preserved. Logs are written to OUT.training.
        classifier: Settings of the classifier.
        members: Number of classifiers; their probabilities are averaged.
    """
    from benchnav.models.training.networks import classifier_of, train_networks

    train_networks(options, data, out, classifier_of(classifier), members=members)


def train_gp(
    data: str,
    out: str,
    gp: LatentGPConfig = _DEFAULT_GP,
    seed: int = 0,
    device: Device = "auto",
    overwrite: bool = False,
) -> None:
    """Train the class-wise Gaussian processes.

    Args:
        data: Path or id of a dataset with splits train and valid; or a file of slip logs
            (.csv, .tsv, .csv.gz, .tsv.gz or .parquet) with the columns class, slope_deg
            and traversability, and optionally drive, to hold out whole drives.
        out: Checkpoint folder; classifiers in it for the same classes are preserved, and
            their class names are used to read slip logs.
        gp: Settings of the GPs.
        seed: Root seed of the selection of held-out rows or drives of slip logs.
        device: Device for training; auto uses CUDA if there is a GPU.
        overwrite: Replace existing GPs, or a checkpoint for other classes.
    """
    from benchnav.models.training.fit import FitOptions
    from benchnav.models.training.gaussian_processes import train_gps

    train_gps(data, out, gp, FitOptions(seed=seed, device=device, overwrite=overwrite))


def train_all(
    options: TrainOptions,
    data: str,
    out: str,
    classifier: ClassifierConfig = _DEFAULT_CLASSIFIER,
    gp: LatentGPConfig = _DEFAULT_GP,
    members: int = 1,
) -> None:
    """Train a complete model: Gaussian processes and classifiers.

    Args:
        options: Training options.
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder. Logs are written to OUT.training.
        classifier: Settings of the classifier.
        gp: Settings of the GPs.
        members: Number of classifiers; their probabilities are averaged.
    """
    from benchnav.models.training.networks import classifier_of, train_networks

    train_networks(options, data, out, classifier_of(classifier), gp, members)


def train_mdn(
    options: TrainOptions, data: str, out: str, mdn: MDNConfig = _DEFAULT_MDN
) -> None:
    """Train a mixture density network, which needs no terrain classes.

    Args:
        options: Training options.
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder. Logs are written to OUT.training.
        mdn: Settings of the network.
    """
    from benchnav.models.training.find import find_trainable
    from benchnav.models.training.networks import train_networks

    train_networks(options, data, out, find_trainable("mdn", vars(mdn)))


COMMANDS = {
    "fit": Command(fit, ("model",)),
    "classifier": Command(train_classifier),
    "gp": Command(train_gp),
    "all": Command(train_all),
    "mdn": Command(train_mdn),
    "evaluate": Command(evaluate_command, ("checkpoint",)),
    "compare": Command(compare, ("models",)),
    "export": Command(export, ("checkpoint",)),
}


def main() -> None:
    """Run `benchnav-train`."""
    sys.exit(
        run("benchnav-train", "Train and measure models of traversability.", COMMANDS)
    )
