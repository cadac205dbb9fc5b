"""The command `benchnav-train`: train models and measure them."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from benchnav.core.command import INTERRUPTED, Command, Device, run
from benchnav.models.config import (
    ClassifierConfig,
    LatentGPConfig,
    MDNConfig,
    NetworkConfig,
    TrainOptions,
    check_seed,
)
from benchnav.models.quality.command import evaluate

if TYPE_CHECKING:
    from benchnav.datagen.files.reader import TerrainDataset
    from benchnav.models.training.fit import FitOptions
    from benchnav.models.training.target import Target

_RESUMABLE = ("classifier", "all", "mdn")
_DEFAULT_CLASSIFIER, _DEFAULT_GP, _DEFAULT_MDN = ClassifierConfig(), LatentGPConfig(), MDNConfig()


def train_classifier(
    options: TrainOptions,
    data: str,
    out: str,
    classifier: ClassifierConfig = _DEFAULT_CLASSIFIER,
    members: int = 1,
) -> None:
    """Train the terrain classifier, or an ensemble of them.

    Args:
        options: How.
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder; Gaussian processes in it for the same classes are kept. Logs go to OUT.training.
        classifier: Settings of the classifier.
        members: How many to train; their probabilities are averaged.
    """
    _train(options, data, out, classifier, members=members)


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
    options = FitOptions(seed=seed, device=device, overwrite=overwrite)
    if data.endswith(ENDINGS):
        train_gps_on_logs(data, out, gp, seed, options)
        return
    dataset = _open_dataset(data)
    target = _open_target(out, dataset, ["gp"], options)
    target.add("gp", train_gps_on_maps(gp, dataset, seed, options.place))


def train_all(
    options: TrainOptions,
    data: str,
    out: str,
    classifier: ClassifierConfig = _DEFAULT_CLASSIFIER,
    gp: LatentGPConfig = _DEFAULT_GP,
    members: int = 1,
) -> None:
    """Train a whole model: Gaussian processes and classifiers.

    Args:
        options: How.
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder. Logs go to OUT.training.
        classifier: Settings of the classifier.
        gp: Settings of the GPs.
        members: How many classifiers to train; their probabilities are averaged.
    """
    _train(options, data, out, classifier, gp, members)


def train_mdn(options: TrainOptions, data: str, out: str, mdn: MDNConfig = _DEFAULT_MDN) -> None:
    """Train a mixture-density network, which needs no terrain classes.

    Args:
        options: How.
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder. Logs go to OUT.training.
        mdn: Settings of the network.
    """
    _train(options, data, out, mdn)


def _train(
    how: TrainOptions,
    data: str,
    out: str,
    config: NetworkConfig,
    gp: LatentGPConfig | None = None,
    members: int = 1,
) -> None:
    """Trains what a checkpoint lacks of a model: the class-wise GPs where they are asked for, then networks."""
    from benchnav.core.errors import ConfigError
    from benchnav.core.store import output_path
    from benchnav.models.checkpoint import CLASSIFIER, FUSED, GP, member_name, training_folder
    from benchnav.models.training.fit import FitOptions
    from benchnav.models.training.gps import train_gps_on_maps
    from benchnav.models.training.networks import NETWORKS, check_network, train_parts

    if members < 1:
        raise ConfigError(f"Expected `members` ≥ 1, got {members}.")
    check_seed(how.seed, members)
    output_path(out)  # refuses addresses
    dataset, trainer = _open_dataset(data), dict(how.trainer or {})
    # The length of training is the network's own setting, wherever it is said.
    config = replace(config, max_epochs=trainer.pop("max_epochs", config.max_epochs))
    options = FitOptions(**{**vars(how), "trainer": trainer, "folder": training_folder(out)})
    check_network(config, dataset, options)
    part = NETWORKS[type(config)].part
    parts = [member_name(index) for index in range(members)] if part == CLASSIFIER else [part]
    model = FUSED if part == CLASSIFIER else part
    target = _open_target(out, dataset, [*([GP] if gp else []), *parts], options, model)
    if gp and not target.holds(GP, gp, how.seed):
        target.add(GP, train_gps_on_maps(gp, dataset, how.seed, options.place))
    train_parts(target, config, dataset, parts)
    if not target.changed:
        print(f"{out} was finished already, with {' and '.join(sorted(target.checkpoint.parts))}")


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


def _open_target(
    out: str, dataset: "TerrainDataset", parts: list[str], options: "FitOptions", model: str = "fused"
) -> "Target":
    from benchnav.models.checkpoint import Checkpoint
    from benchnav.models.training.data import training_digest
    from benchnav.models.training.target import open_target

    fresh = Checkpoint(class_names=tuple(item.name for item in dataset.recipe.classes), model=model)
    return open_target(Path(out), fresh, parts, training_digest(dataset), options)


def main() -> None:
    """Entry point of `benchnav-train`."""
    commands = {
        "classifier": Command(train_classifier, settings=TrainOptions),
        "gp": Command(train_gp),
        "all": Command(train_all, settings=TrainOptions),
        "mdn": Command(train_mdn, settings=TrainOptions),
        "evaluate": Command(evaluate, ("checkpoint",)),
    }
    status = run("benchnav-train", "Train and measure models of traversability.", commands)
    if status == INTERRUPTED and sys.argv[1] in _RESUMABLE:
        anew = any(word.startswith("--overwrite") for word in sys.argv)
        instead = " in place of --overwrite" if anew else ""
        print(f"benchnav-train: to go on, give the same command with --resume{instead}", file=sys.stderr)
    sys.exit(status)
