"""The command `benchnav-train`: train models and measure them."""

import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from benchnav.core.command import INTERRUPTED, Command, Device, run
from benchnav.models.config import ClassifierConfig, LatentGPConfig, MDNConfig, check_seed
from benchnav.models.quality.command import evaluate

if TYPE_CHECKING:
    from benchnav.datagen.files.reader import TerrainDataset
    from benchnav.models.training.fit import FitOptions
    from benchnav.models.training.target import Target

_RESUMABLE = ("classifier", "all", "mdn")
_DEFAULT_CLASSIFIER, _DEFAULT_GP, _DEFAULT_MDN = ClassifierConfig(), LatentGPConfig(), MDNConfig()
Config = TypeVar("Config", ClassifierConfig, MDNConfig)


def train_classifier(
    data: str,
    out: str,
    classifier: ClassifierConfig = _DEFAULT_CLASSIFIER,
    members: int = 1,
    seed: int = 0,
    device: Device = "auto",
    trainer: dict[str, Any] | None = None,
    workers: int = 0,
    in_memory: bool = False,
    half_precision: bool = True,
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Train the terrain classifier, or an ensemble of them.

    Args:
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder; Gaussian processes in it for the same classes are kept. Logs go to OUT.training.
        classifier: Settings of the classifier.
        members: How many to train, with the seeds SEED, SEED + 1, …; their probabilities are averaged.
        seed: Root seed of weights, order and augmentation.
        device: Where it is trained and calibrated; auto takes CUDA where there is a GPU.
        trainer: Settings of Lightning's trainer, for example --trainer.devices 2 --trainer.precision 32-true.
        workers: Processes that read maps ahead. The result is the same for any number.
        in_memory: Hold all maps in memory, in place of reading them as they are asked for.
        half_precision: Store the weights as float16.
        resume: Go on with a training that was interrupted; whole epochs are kept.
        overwrite: Replace classifiers, or a checkpoint of other classes, that are there.
    """
    from benchnav.models.training.classifiers import check_classifier, train_members

    names, dataset = _members(members, seed), _open_dataset(data)
    classifier, options = _options(out, classifier, device, trainer, resume, workers, in_memory)
    check_classifier(classifier, dataset, options)
    target = _open_target(out, dataset, names, options, overwrite)
    train_members(target, classifier, dataset, members, seed, options, half_precision)


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
        data: Path or id of a dataset with splits train and valid; or slip logs, a file .csv, .tsv, one of these
            with .gz, or .parquet, with the columns class, slope_deg and traversability.
        out: Checkpoint folder; classifiers in it for the same classes are kept, and slip logs are read with
            their class table.
        gp: Settings of the GPs.
        seed: Root seed of the rows of slip logs that are held out to measure on.
        device: Where they are trained; auto takes CUDA where there is a GPU.
        overwrite: Replace GPs, or a checkpoint of other classes, that are there.
    """
    from benchnav.core.store import output_path
    from benchnav.models.slope_gp.slip_logs import ENDINGS
    from benchnav.models.training.fit import FitOptions
    from benchnav.models.training.gps import train_gps_on_logs, train_gps_on_maps

    check_seed(seed)
    output_path(out)  # refuses addresses
    options = FitOptions(device=device)
    if data.endswith(ENDINGS):
        train_gps_on_logs(data, out, gp, seed, options, overwrite)
        return
    dataset = _open_dataset(data)
    target = _open_target(out, dataset, ["gp"], options, overwrite)
    target.add("gp", train_gps_on_maps(gp, dataset, seed, options))


def train_all(
    data: str,
    out: str,
    classifier: ClassifierConfig = _DEFAULT_CLASSIFIER,
    gp: LatentGPConfig = _DEFAULT_GP,
    members: int = 1,
    seed: int = 0,
    device: Device = "auto",
    trainer: dict[str, Any] | None = None,
    workers: int = 0,
    in_memory: bool = False,
    half_precision: bool = True,
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Train a whole model: Gaussian processes and classifiers.

    Args:
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder. Logs go to OUT.training.
        classifier: Settings of the classifier.
        gp: Settings of the GPs.
        members: How many classifiers to train; their probabilities are averaged.
        seed: Root seed.
        device: Where it is trained and calibrated; auto takes CUDA where there is a GPU.
        trainer: Settings of Lightning's trainer for the classifiers.
        workers: Processes that read maps ahead. The result is the same for any number.
        in_memory: Hold all maps in memory, in place of reading them as they are asked for.
        half_precision: Store the classifiers' weights as float16.
        resume: Go on with a training that was interrupted; finished parts and whole epochs are kept.
        overwrite: Replace a checkpoint that is there.
    """
    from benchnav.models.training.classifiers import check_classifier, train_members
    from benchnav.models.training.gps import train_gps_on_maps

    names, dataset = _members(members, seed), _open_dataset(data)
    classifier, options = _options(out, classifier, device, trainer, resume, workers, in_memory)
    check_classifier(classifier, dataset, options)
    target = _open_target(out, dataset, ["gp", *names], options, overwrite)
    if not target.holds("gp", asdict(gp), seed, asdict(LatentGPConfig())):
        target.add("gp", train_gps_on_maps(gp, dataset, seed, options))
    train_members(target, classifier, dataset, members, seed, options, half_precision)


def train_mdn(
    data: str,
    out: str,
    mdn: MDNConfig = _DEFAULT_MDN,
    seed: int = 0,
    device: Device = "auto",
    trainer: dict[str, Any] | None = None,
    workers: int = 0,
    in_memory: bool = False,
    half_precision: bool = True,
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Train a mixture-density network, which needs no terrain classes.

    Args:
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder. Logs go to OUT.training.
        mdn: Settings of the network.
        seed: Root seed of weights, order and augmentation.
        device: Where it is trained and calibrated; auto takes CUDA where there is a GPU.
        trainer: Settings of Lightning's trainer, for example --trainer.devices 2 --trainer.precision 32-true.
        workers: Processes that read maps ahead. The result is the same for any number.
        in_memory: Hold all maps in memory, in place of reading them as they are asked for.
        half_precision: Store the weights as float16.
        resume: Go on with a training that was interrupted; whole epochs are kept.
        overwrite: Replace a checkpoint that is there.
    """
    from benchnav.models.nets.mdn import MDN
    from benchnav.models.training.mdn import check_mdn, train_mdn_part

    check_seed(seed)
    dataset = _open_dataset(data)
    mdn, options = _options(out, mdn, device, trainer, resume, workers, in_memory)
    check_mdn(mdn, dataset, options)
    target = _open_target(out, dataset, [MDN], options, overwrite, model=MDN)
    if not target.holds(MDN, asdict(mdn), seed, asdict(MDNConfig()), half_precision):
        target.add(MDN, train_mdn_part(mdn, dataset, seed, options, half_precision))


def _open_dataset(data: str) -> "TerrainDataset":
    from benchnav.core.errors import DatasetError
    from benchnav.datagen.files.reader import TerrainDataset, find_dataset

    dataset = TerrainDataset(find_dataset(data))
    if not {"train", "valid"} <= set(dataset.splits):
        raise DatasetError(
            f"Expected splits train and valid in {dataset.path} to train on, got {sorted(dataset.splits)}. "
            "Make a dataset with them, for example `benchnav-datagen create paper-v1`."
        )
    return dataset


def _options(
    out: str,
    config: Config,
    device: str,
    trainer: dict[str, Any] | None,
    resume: bool,
    workers: int,
    in_memory: bool,
) -> "tuple[Config, FitOptions]":
    """Gives the trainer's settings; the length of training is the model's own setting, wherever it is said."""
    from benchnav.core.store import output_path
    from benchnav.models.checkpoint import training_folder
    from benchnav.models.training.fit import FitOptions

    output_path(out)  # refuses addresses
    settings = dict(trainer or {})
    if "max_epochs" in settings:
        config = replace(config, max_epochs=settings.pop("max_epochs"))
    folder = training_folder(out)
    return config, FitOptions(
        folder=folder, resume=resume, trainer=settings, workers=workers, in_memory=in_memory, device=device
    )


def _members(count: int, seed: int) -> list[str]:
    from benchnav.core.errors import ConfigError
    from benchnav.models.checkpoint import member_name

    if count < 1:
        raise ConfigError(f"Expected `members` ≥ 1, got {count}.")
    check_seed(seed, count)
    return [member_name(index) for index in range(count)]


def _open_target(
    out: str,
    dataset: "TerrainDataset",
    parts: list[str],
    options: "FitOptions",
    overwrite: bool,
    model: str = "",
) -> "Target":
    from benchnav.models.checkpoint import FUSED, Checkpoint
    from benchnav.models.training.data import training_digest
    from benchnav.models.training.target import open_target

    fresh = Checkpoint(class_names=tuple(item.name for item in dataset.recipe.classes), model=model or FUSED)
    return open_target(Path(out), fresh, parts, training_digest(dataset), options, overwrite)


def main() -> None:
    """Entry point of `benchnav-train`."""
    commands = {
        "classifier": Command(train_classifier),
        "gp": Command(train_gp),
        "all": Command(train_all),
        "mdn": Command(train_mdn),
        "evaluate": Command(evaluate, ("checkpoint",)),
    }
    status = run("benchnav-train", "Train and measure models of traversability.", commands)
    if status == INTERRUPTED and sys.argv[1] in _RESUMABLE:
        anew = any(word.startswith("--overwrite") for word in sys.argv)
        instead = " in place of --overwrite" if anew else ""
        print(f"benchnav-train: to go on, give the same command with --resume{instead}", file=sys.stderr)
    sys.exit(status)
