"""The command `benchnav-train`: train the halves of a model and measure the whole."""

import os
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from benchnav.command import Command, run
from benchnav.models.config import ClassifierConfig, LatentGPConfig

if TYPE_CHECKING:
    from benchnav.datagen.store import TerrainDataset
    from benchnav.models.calibration import Quality
    from benchnav.models.checkpoint import Checkpoint, Part

Precision = Literal["bf16-mixed", "32-true", "16-mixed"]
Device = Literal["auto", "cpu", "cuda"]

_DEFAULT_CLASSIFIER, _DEFAULT_GP = ClassifierConfig(), LatentGPConfig()


def train_classifier(
    data: str,
    out: str,
    classifier: ClassifierConfig = _DEFAULT_CLASSIFIER,
    seed: int = 0,
    precision: Precision = "bf16-mixed",
    device: Device = "auto",
    half_precision: bool = True,
    overwrite: bool = False,
) -> None:
    """Train the terrain classifier.

    Args:
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder; a GP half in it that was trained on the same maps is kept.
        classifier: Settings of the classifier.
        seed: Root seed of weights, order and augmentation.
        precision: Arithmetic of training.
        device: Where to train.
        half_precision: Store the weights as float16.
        overwrite: Replace a classifier, or a checkpoint of other maps, that is there.
    """
    dataset, checkpoint = _start(data, out, {"classifier"}, overwrite)
    checkpoint = checkpoint.with_part(
        "classifier", _fit_classifier(classifier, dataset, seed, precision, device)
    )
    _save(out, checkpoint, half_precision)


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
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder; a classifier half in it that was trained on the same maps is kept.
        gp: Settings of the GPs.
        seed: Root seed of subsample and batches.
        device: Where to train.
        overwrite: Replace GPs, or a checkpoint of other maps, that are there.
    """
    dataset, checkpoint = _start(data, out, {"gp"}, overwrite)
    _save(out, checkpoint.with_part("gp", _fit_gp(gp, dataset, seed, device)), True)


def train_all(
    data: str,
    out: str,
    classifier: ClassifierConfig = _DEFAULT_CLASSIFIER,
    gp: LatentGPConfig = _DEFAULT_GP,
    seed: int = 0,
    precision: Precision = "bf16-mixed",
    device: Device = "auto",
    half_precision: bool = True,
    overwrite: bool = False,
) -> None:
    """Train a whole model: Gaussian processes and classifier.

    Args:
        data: Path or id of a dataset with splits train and valid.
        out: Checkpoint folder.
        classifier: Settings of the classifier.
        gp: Settings of the GPs.
        seed: Root seed.
        precision: Arithmetic of the classifier's training.
        device: Where to train.
        half_precision: Store the classifier's weights as float16.
        overwrite: Replace a checkpoint that is there.
    """
    dataset, checkpoint = _start(data, out, {"classifier", "gp"}, overwrite)
    if not _is_done(checkpoint, gp, seed):
        checkpoint = checkpoint.with_part("gp", _fit_gp(gp, dataset, seed, device))
        _save(out, checkpoint, half_precision)
    checkpoint = checkpoint.with_part(
        "classifier", _fit_classifier(classifier, dataset, seed, precision, device)
    )
    _save(out, checkpoint, half_precision)


def evaluate(
    checkpoint: str, data: str, splits: list[str] | None = None, json: str = "", seed: int = 0
) -> None:
    """Measure a model on the test splits of a dataset.

    Args:
        checkpoint: Checkpoint folder, or name of a registered model such as oracle.
        data: Path or id of a dataset.
        splits: Which splits, for example [test/std,valid]; every test split when not given.
        json: File to write the figures to as well.
        seed: Root seed of the draws that place clipped values within their atoms.
    """
    from rich.console import Console

    from benchnav.datagen.store import TerrainDataset, find_dataset
    from benchnav.errors import ConfigError
    from benchnav.models.baseline import nearest_colour_accuracy
    from benchnav.models.calibration import evaluate as evaluate_model
    from benchnav.models.predictor import load_model

    target = Path(json) if json else None
    if target and not target.parent.is_dir():
        raise ConfigError(f"Expected `json` in a folder that exists, got {json}. Make {target.parent} first.")
    dataset = TerrainDataset(find_dataset(data))
    qualities = dict(evaluate_model(load_model(checkpoint), dataset, splits or (), seed))
    console = Console(width=None if sys.stdout.isatty() else 124, highlight=False)
    console.print(_table(checkpoint, dataset, qualities.items()))
    by_colour = ", ".join(f"{split} {nearest_colour_accuracy(dataset, split):.4f}" for split in qualities)
    console.print(f"accuracy of the class of the nearest colour: {by_colour}", soft_wrap=True)
    if target:
        _write_json(target, checkpoint, dataset, qualities)
        print(f"wrote {target}")


def _start(data: str, out: str, names: set[str], overwrite: bool) -> "tuple[TerrainDataset, Checkpoint]":
    """Opens the dataset and the checkpoint that training goes into; refuses before any work is done."""
    from benchnav.datagen.store import TerrainDataset, find_dataset
    from benchnav.errors import CheckpointError, DatasetError
    from benchnav.models.checkpoint import Checkpoint, load_checkpoint

    dataset = TerrainDataset(find_dataset(data))
    missing = [split for split in ("train", "valid") if split not in dataset.splits]
    if missing:
        raise DatasetError(
            f"Expected splits train and valid in {dataset.path} to train on, got {sorted(dataset.splits)}. "
            "Make a dataset with them, for example `benchnav-datagen create paper-v1`."
        )
    fresh = Checkpoint(
        class_names=tuple(item.name for item in dataset.recipe.classes),
        dataset_id=dataset.id,
        dataset_digest=",".join(f"{name}:{dataset.splits[name]['digest']}" for name in ("train", "valid")),
    )
    if not Path(out).exists():
        # Whether a checkpoint can be written there shows now rather than after the training.
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        os.rmdir(tempfile.mkdtemp(dir=Path(out).parent))
        return dataset, fresh
    if not (Path(out) / "config.json").is_file():
        raise CheckpointError(
            f"Expected `out` to be a new folder or a checkpoint, got {out}, which is something else."
        )
    if overwrite and len(names) > 1:
        return dataset, fresh
    there = load_checkpoint(out)
    fits = (there.dataset_digest, there.class_names) == (fresh.dataset_digest, fresh.class_names)
    if overwrite:
        return dataset, there if fits else fresh
    if not fits:
        raise CheckpointError(
            f"Expected checkpoint {out} to be of the maps of {dataset.path}, got one of other maps, of "
            f"dataset {there.dataset_id}. Choose another `out`, or pass --overwrite to replace it."
        )
    # GPs alone are what an interrupted training of both halves leaves, to be gone on from.
    if (names & set(there.parts)) - ({"gp"} if len(names) > 1 else set()):
        raise CheckpointError(
            f"Expected `out` without a trained {' or '.join(sorted(names))}, got {out} with "
            f"{' and '.join(sorted(there.parts))}. Choose another `out`, or pass --overwrite to "
            "replace it."
        )
    return dataset, there


def _is_done(checkpoint: "Checkpoint", gp: LatentGPConfig, seed: int) -> bool:
    """Tells whether an interrupted training of both halves has left its GPs there."""
    part = checkpoint.parts.get("gp")
    return part is not None and part.seed == seed and asdict(gp).items() <= part.config.items()


def _fit_classifier(
    config: ClassifierConfig, dataset: "TerrainDataset", seed: int, precision: str, device: str
) -> "Part":
    from benchnav.models.checkpoint import Part
    from benchnav.models.training import fit_classifier

    model, metrics = fit_classifier(config, dataset, seed, precision, device)
    print(
        f"classifier: best epoch {metrics['epoch']:.0f}, validation accuracy "
        f"{metrics['valid_accuracy']:.4f}, mIoU {metrics['valid_miou']:.4f}, loss {metrics['valid_loss']:.4f}"
    )
    return Part(config=asdict(config), tensors=dict(model.state_dict()), seed=seed, metrics=metrics)


def _fit_gp(config: LatentGPConfig, dataset: "TerrainDataset", seed: int, device: str) -> "Part":
    from benchnav.models.calibration import measure_latent
    from benchnav.models.checkpoint import Part
    from benchnav.models.data import read_pixels
    from benchnav.models.training import fit_gps

    table = read_pixels(dataset, "train", config.max_points, seed)
    model = fit_gps(config, table, seed, device)
    metrics = {
        f"valid_{name}": value
        for name, value in measure_latent(model.tabulate(), dataset.terrain("valid")).items()
    }
    print(
        f"gps: validation RMSE of the latent mean {metrics['valid_latent_rmse']:.4f}, largest error of the "
        f"noise {metrics['valid_noise_error']:.1%}, NLL {metrics['valid_nll']:.4f}"
    )
    settings = {**asdict(config), "steepest_deg": model.steepest_deg}
    return Part(config=settings, tensors=model.to_tensors(), seed=seed, metrics=metrics)


def _save(out: str, checkpoint: "Checkpoint", half_precision: bool) -> None:
    from benchnav.models.checkpoint import save_checkpoint

    save_checkpoint(out, checkpoint, half_precision)
    size = sum(path.stat().st_size for path in Path(out).iterdir())
    print(f"wrote {out} with {' and '.join(sorted(checkpoint.parts))} ({size / 1e6:.1f} MB)")


def _table(name: str, dataset: "TerrainDataset", qualities: "Iterable[tuple[str, Quality]]") -> object:
    from rich.table import Table

    columns = (
        "accuracy",
        "mIoU",
        "ECE",
        "Brier",
        "RMSE λ",
        "RMSE E[λ]",
        "NLL",
        "CRPS",
        "90 % cover",
        "tail 0.1",
    )
    table = Table("split", "maps", *columns, title=f"{name} on {dataset.id}")
    for split, quality in qualities:
        classes = [f"{value:.4f}" for item in quality.classes for value in asdict(item).values()] or ["–"] * 4
        rest = [f"{value:.4f}" for value in asdict(quality.traversability).values()]
        table.add_row(split, str(quality.maps), *classes, *rest)
    return table


def _write_json(target: Path, name: str, dataset: "TerrainDataset", qualities: "dict[str, Quality]") -> None:
    import json

    from benchnav.errors import ConfigError

    report = {
        "model": name,
        "dataset": {"id": dataset.id, "digest": dataset.digest},
        "splits": {
            split: {
                "maps": quality.maps,
                **{key: value for item in quality.classes for key, value in asdict(item).items()},
                **asdict(quality.traversability),
            }
            for split, quality in qualities.items()
        },
    }
    try:
        target.write_text(json.dumps(report, indent=1) + "\n")
    except OSError as error:
        raise ConfigError(f"Could not write {target}: {error.strerror}. Choose another `json`.") from error


def main() -> None:
    """Entry point of `benchnav-train`."""
    commands = {
        "classifier": Command(train_classifier),
        "gp": Command(train_gp),
        "all": Command(train_all),
        "evaluate": Command(evaluate, ("checkpoint",)),
    }
    sys.exit(run("benchnav-train", "Train and measure models of traversability.", commands))
