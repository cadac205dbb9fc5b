"""The command `benchnav-train`: train models and measure them."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from benchnav.command import INTERRUPTED, Command, run
from benchnav.models.config import ClassifierConfig, LatentGPConfig, MDNConfig
from benchnav.models.quality.command import evaluate

if TYPE_CHECKING:
    from benchnav.datagen.files.reader import TerrainDataset
    from benchnav.models.checkpoint import Part
    from benchnav.models.slope_gp.gp import LatentGPs
    from benchnav.models.training.fit import FitOptions
    from benchnav.models.training.target import Target

_HELD_OUT = 0.1  # of slip logs
_FEW_ROWS = 10  # of a class in slip logs
_RESUMABLE = ("classifier", "all", "mdn")
_DEFAULT_CLASSIFIER, _DEFAULT_GP, _DEFAULT_MDN = ClassifierConfig(), LatentGPConfig(), MDNConfig()
Config = TypeVar("Config", ClassifierConfig, MDNConfig)


def train_classifier(
    data: str,
    out: str,
    classifier: ClassifierConfig = _DEFAULT_CLASSIFIER,
    members: int = 1,
    seed: int = 0,
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
        trainer: Settings of Lightning's trainer, for example --trainer.devices 2 --trainer.precision 32-true.
        workers: Processes that read maps ahead. The result is the same for any number.
        in_memory: Hold all maps in memory, in place of reading them as they are asked for.
        half_precision: Store the weights as float16.
        resume: Go on with a training that was interrupted; whole epochs are kept.
        overwrite: Replace classifiers, or a checkpoint of other classes, that are there.
    """
    dataset = _open_dataset(data)
    classifier, options = _options(out, classifier, trainer, resume, workers, in_memory)
    target = _open_target(out, dataset, _members(members), options, overwrite)
    _train_members(target, classifier, dataset, members, seed, options, half_precision)


def train_gp(
    data: str,
    out: str,
    gp: LatentGPConfig = _DEFAULT_GP,
    seed: int = 0,
    trainer: dict[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Train the class-wise Gaussian processes.

    Args:
        data: Path or id of a dataset with splits train and valid; or slip logs, a file .csv or .parquet with
            the columns class, slope_deg and traversability.
        out: Checkpoint folder; classifiers in it for the same classes are kept, and slip logs are read with
            their class table.
        gp: Settings of the GPs.
        seed: Root seed of the rows of slip logs that are held out to measure on.
        trainer: Settings of Lightning's trainer, of which the accelerator alone counts.
        overwrite: Replace GPs, or a checkpoint of other classes, that are there.
    """
    from benchnav.models.training.fit import FitOptions

    options = FitOptions(trainer=trainer or {})
    if data.endswith((".csv", ".parquet")):
        _train_gp_on_logs(data, out, gp, seed, options, overwrite)
        return
    dataset = _open_dataset(data)
    target = _open_target(out, dataset, ["gp"], options, overwrite)
    target.add("gp", _fit_gp(gp, dataset, seed, options))


def train_all(
    data: str,
    out: str,
    classifier: ClassifierConfig = _DEFAULT_CLASSIFIER,
    gp: LatentGPConfig = _DEFAULT_GP,
    members: int = 1,
    seed: int = 0,
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
        trainer: Settings of Lightning's trainer for the classifiers; of the GPs' the accelerator.
        workers: Processes that read maps ahead. The result is the same for any number.
        in_memory: Hold all maps in memory, in place of reading them as they are asked for.
        half_precision: Store the classifiers' weights as float16.
        resume: Go on with a training that was interrupted; finished parts and whole epochs are kept.
        overwrite: Replace a checkpoint that is there.
    """
    dataset = _open_dataset(data)
    classifier, options = _options(out, classifier, trainer, resume, workers, in_memory)
    target = _open_target(out, dataset, ["gp", *_members(members)], options, overwrite)
    if not target.holds("gp", asdict(gp), seed, asdict(LatentGPConfig())):
        target.add("gp", _fit_gp(gp, dataset, seed, options))
    _train_members(target, classifier, dataset, members, seed, options, half_precision)


def train_mdn(
    data: str,
    out: str,
    mdn: MDNConfig = _DEFAULT_MDN,
    seed: int = 0,
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
        trainer: Settings of Lightning's trainer, for example --trainer.devices 2 --trainer.precision 32-true.
        workers: Processes that read maps ahead. The result is the same for any number.
        in_memory: Hold all maps in memory, in place of reading them as they are asked for.
        half_precision: Store the weights as float16.
        resume: Go on with a training that was interrupted; whole epochs are kept.
        overwrite: Replace a checkpoint that is there.
    """
    from benchnav.models.checkpoint import Checkpoint, Part
    from benchnav.models.nets.mdn import MDN
    from benchnav.models.training.target import open_target
    from benchnav.models.training.train import training_digest
    from benchnav.models.training.train_mdn import fit_mdn

    dataset = _open_dataset(data)
    mdn, options = _options(out, mdn, trainer, resume, workers, in_memory)
    fresh = Checkpoint(class_names=tuple(item.name for item in dataset.recipe.classes), model=MDN)
    target = open_target(Path(out), fresh, [MDN], training_digest(dataset), options, overwrite)
    if target.holds(MDN, asdict(mdn), seed, asdict(MDNConfig())):
        return
    network, metrics = fit_mdn(mdn, dataset, seed, options, half_precision)
    _say(
        f"mdn: best epoch {metrics['epoch']:.0f}, validation NLL {metrics['valid_loss']:.4f}, "
        f"RMSE {metrics['valid_rmse']:.4f}"
    )
    part = Part(
        config=asdict(mdn),
        tensors=dict(network.state_dict()),
        seed=seed,
        metrics=metrics,
        data_id=dataset.id,
        data_digest=training_digest(dataset),
        half_precision=half_precision,
    )
    target.add(MDN, part)


def _open_dataset(data: str) -> "TerrainDataset":
    from benchnav.datagen.files.reader import TerrainDataset, find_dataset
    from benchnav.errors import DatasetError

    dataset = TerrainDataset(find_dataset(data))
    if not {"train", "valid"} <= set(dataset.splits):
        raise DatasetError(
            f"Expected splits train and valid in {dataset.path} to train on, got {sorted(dataset.splits)}. "
            "Make a dataset with them, for example `benchnav-datagen create paper-v1`."
        )
    return dataset


def _options(
    out: str, config: Config, trainer: dict[str, Any] | None, resume: bool, workers: int, in_memory: bool
) -> "tuple[Config, FitOptions]":
    """Gives the trainer's settings; the length of training is the model's own setting, wherever it is said."""
    from benchnav.models.checkpoint import training_folder
    from benchnav.models.training.fit import FitOptions

    settings = dict(trainer or {})
    if "max_epochs" in settings:
        config = replace(config, max_epochs=settings.pop("max_epochs"))
    folder = training_folder(out)
    return config, FitOptions(
        folder=folder, resume=resume, trainer=settings, workers=workers, in_memory=in_memory
    )


def _members(count: int) -> list[str]:
    from benchnav.errors import ConfigError
    from benchnav.models.checkpoint import member_name

    if count < 1:
        raise ConfigError(f"Expected `members` ≥ 1, got {count}.")
    return [member_name(index) for index in range(count)]


def _open_target(
    out: str, dataset: "TerrainDataset", parts: list[str], options: "FitOptions", overwrite: bool
) -> "Target":
    from benchnav.models.checkpoint import Checkpoint
    from benchnav.models.training.target import open_target
    from benchnav.models.training.train import training_digest

    fresh = Checkpoint(class_names=tuple(item.name for item in dataset.recipe.classes))
    return open_target(Path(out), fresh, parts, training_digest(dataset), options, overwrite)


def _train_members(
    target: "Target",
    config: ClassifierConfig,
    dataset: "TerrainDataset",
    members: int,
    seed: int,
    options: "FitOptions",
    half_precision: bool,
) -> None:
    for index, part in enumerate(_members(members)):
        if not target.holds(part, asdict(config), seed + index, asdict(ClassifierConfig())):
            trained = _fit_classifier(config, dataset, seed + index, options, part, half_precision)
            target.add(part, trained)
    _calibrate_pool(target, dataset, seed)


def _calibrate_pool(target: "Target", dataset: "TerrainDataset", seed: int) -> None:
    """Fits the temperature of the pool of all classifiers that are there, as they are kept."""
    from benchnav.models.checkpoint import as_stored, member_names
    from benchnav.models.nets.classifier import TerrainClassifier
    from benchnav.models.training.data import VALID, read_maps
    from benchnav.models.training.fit import is_first_process
    from benchnav.models.training.temperature import fit_pool_temperature

    there = target.checkpoint
    parts = [there.part(name) for name in member_names(there)]
    if len(parts) == 1 or not is_first_process():
        return
    classes = len(there.class_names)
    members = [
        TerrainClassifier.from_tensors(part.config, classes, as_stored(part.tensors, part.half_precision))
        for part in parts
    ]
    temperature = fit_pool_temperature(members, read_maps(dataset, VALID), seed)
    _say(f"pool of {len(members)} classifiers: temperature {temperature:.3f}")
    target.set_pool_temperature(temperature)


def _fit_classifier(
    config: ClassifierConfig,
    dataset: "TerrainDataset",
    seed: int,
    options: "FitOptions",
    part: str,
    half_precision: bool,
) -> "Part":
    from benchnav.models.checkpoint import Part
    from benchnav.models.training.train import fit_classifier, training_digest

    model, metrics = fit_classifier(config, dataset, seed, options, part, half_precision)
    _say(
        f"{part}: best epoch {metrics['epoch']:.0f}, validation accuracy {metrics['valid_accuracy']:.4f}, "
        f"mIoU {metrics['valid_miou']:.4f}, loss {metrics['valid_loss']:.4f}, "
        f"temperature {model.temperature:.3f}"
    )
    return Part(
        config={**asdict(config), "temperature": model.temperature},
        tensors=dict(model.state_dict()),
        seed=seed,
        metrics=metrics,
        data_id=dataset.id,
        data_digest=training_digest(dataset),
        half_precision=half_precision,
    )


def _fit_gp(config: LatentGPConfig, dataset: "TerrainDataset", seed: int, options: "FitOptions") -> "Part":
    from benchnav.models.checkpoint import Part
    from benchnav.models.quality.measure import measure_latent
    from benchnav.models.slope_gp.sums import sum_split
    from benchnav.models.training.train import fit_gps, training_digest

    model = fit_gps(config, sum_split(dataset, "train"), options)
    _say_soft_modes(model, [item.name for item in dataset.recipe.classes])
    measured = measure_latent(model.tabulate(), dataset.terrain_chunks("valid"))
    metrics = {f"valid_{name}": value for name, value in measured.items()}
    _say(
        f"gp: validation RMSE of the latent mean {metrics['valid_latent_rmse']:.4f}, largest error of the "
        f"noise {metrics['valid_noise_error']:.1%}, NLL {metrics['valid_nll']:.4f}"
    )
    return Part(
        config={**asdict(config), "steepest_deg": model.steepest_deg},
        tensors=model.to_tensors(),
        seed=seed,
        metrics=metrics,
        data_id=dataset.id,
        data_digest=training_digest(dataset),
    )


def _train_gp_on_logs(
    data: str, out: str, config: LatentGPConfig, seed: int, options: "FitOptions", overwrite: bool
) -> None:
    from benchnav.models.checkpoint import CONFIG, GP, Checkpoint, Part, load_checkpoint
    from benchnav.models.slope_gp.cells import cell_nll, hold_out
    from benchnav.models.slope_gp.slip_logs import read_slip_logs
    from benchnav.models.slope_gp.sums import SlopeSums
    from benchnav.models.training.target import open_target
    from benchnav.models.training.train import fit_gps

    logs = read_slip_logs(data)
    there = load_checkpoint(out) if (Path(out) / CONFIG).is_file() else None
    names = there.class_names if there else logs.class_names
    cells = logs.cells(names)
    sums = SlopeSums.of(cells, len(names))
    target = open_target(
        Path(out), Checkpoint(class_names=names), ["gp"], f"file:{logs.digest}", options, overwrite
    )
    counts = dict(zip(names, sums.count.tolist(), strict=True))
    _warn_of_rows(data, counts, out if there and GP in there.parts else "")
    metrics = {}
    if max(counts.values()) >= 1 / _HELD_OUT:
        kept, held = hold_out(cells, _HELD_OUT, seed)
        trial = fit_gps(config, SlopeSums.of(kept, len(names)), options)
        metrics["held_out_nll"] = cell_nll(held, trial.tabulate())
        _say(f"gp: NLL of {len(held)} rows held out {metrics['held_out_nll']:.4f}; now with all rows")
    model = fit_gps(config, sums, options)
    _say_soft_modes(model, names)
    seen = ", ".join(f"{name} {count}" for name, count in counts.items())
    _say(f"gp: rows learned from: {seen}")
    part = Part(
        config={**asdict(config), "steepest_deg": model.steepest_deg},
        tensors=model.to_tensors(),
        seed=seed,
        metrics=metrics,
        data_id=Path(data).name,
        data_digest=f"file:{logs.digest}",
    )
    target.add("gp", part)


def _warn_of_rows(data: str, counts: Mapping[str, int], replaced: str) -> None:
    """Names the classes that a file of slip logs says little or nothing of.

    Args:
        data: the file.
        counts: rows by class.
        replaced: the checkpoint whose GPs the new ones replace; empty where there are none.
    """
    if missing := [name for name, count in counts.items() if not count]:
        lost = f", and what {replaced} had learned of them is dropped" if replaced else ""
        _warn(
            f"{data} has no rows of {len(missing)} of {len(counts)} classes ({', '.join(missing)}); their GPs become "
            f"the prior, which is vague{lost}"
        )
    if few := [f"{name} {count}" for name, count in counts.items() if 0 < count < _FEW_ROWS]:
        _warn(
            f"{data} has fewer than {_FEW_ROWS} rows of some classes ({', '.join(few)}); what is predicted of them "
            "is little more than the prior"
        )


def _warn(line: str) -> None:
    print(f"benchnav-train: warning: {line}", file=sys.stderr)


def _say_soft_modes(model: "LatentGPs", class_names: "Sequence[str]") -> None:
    """Names the classes that were found to have a second mode."""
    if model.soft is None:
        return
    numbers = (values.tolist() for values in (model.soft.weight, model.soft.mean, model.soft.std))
    modes = zip(class_names, *numbers, strict=True)
    listed = [
        f"{name} {weight:.1%} of N({mean:.3f}, {std:.3f})" for name, weight, mean, std in modes if weight
    ]
    _say(f"gp: soft spots of {', '.join(listed)}")


def _say(line: str) -> None:
    from benchnav.models.training.fit import is_first_process

    if is_first_process():
        print(line)


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
