"""Training of the class-wise GPs of a fused model, on maps or slip logs."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from benchnav.core.command import Device, tell
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.files.robot_logs import ENDINGS
from benchnav.models.checkpoint import Checkpoint, Part
from benchnav.models.config import LatentGPConfig, check_seed
from benchnav.models.parts import GP
from benchnav.models.slope_gp.cells import (
    Cells,
    SlopeSums,
    cell_nll,
    hold_out,
    hold_out_drives,
    measure_latent,
    sum_split,
)
from benchnav.models.slope_gp.gp import LatentGPs
from benchnav.models.slope_gp.slip_logs import read_slip_log
from benchnav.models.slope_gp.soft_modes import find_soft_modes
from benchnav.models.training.data import TRAIN, VALID, open_dataset, training_digest
from benchnav.models.training.fit import FitOptions, fit, say
from benchnav.models.training.target import existing, fresh_checkpoint, open_target

_HELD_OUT = 0.1  # fraction of the rows of slip logs that is held out
_MIN_ROWS = 10  # number of rows of a class below which a warning is printed


def fit_gps(
    config: LatentGPConfig, sums: SlopeSums, device: Device = "cpu"
) -> LatentGPs:
    """Train the class-wise GPs on sums over cells, in float64 and without randomness.

    Args:
        config: settings of the GPs.
        sums: sums over the cells of all classes, from maps or slip logs.
        device: device of the training.

    Returns:
        The GPs, on the CPU.
    """
    censored = config.likelihood == "censored"
    if config.second_component and censored:
        soft, bins = find_soft_modes(sums)
    else:
        soft = None
        bins = sums.bins(censored)
    model = LatentGPs(config, sums.steepest_deg, soft)
    # Each batch has all cells. With its own generator, the loader does not draw from
    # PyTorch's global generator.
    batches: Any = [bins] * config.epoch_steps
    loader = DataLoader(batches, batch_size=None, generator=torch.Generator())
    fit(
        model,
        GP,
        FitOptions(device=device),
        {},
        [],
        {"train_dataloaders": loader},
        max_epochs=config.epochs,
        precision="64-true",
    )
    return model.cpu().eval()


def train_gps(data: str, out: str, config: LatentGPConfig, options: FitOptions) -> None:
    """Train the GPs on a dataset or on slip logs, and save them in a checkpoint.

    Args:
        data: path or id of a dataset, or path of slip logs.
        out: folder of the checkpoint.
        config: settings of the GPs.
        options: training options.
    """
    check_seed(options.seed)
    if data.endswith(ENDINGS):
        _train_on_logs(data, out, config, options)
        return
    dataset = open_dataset(data)
    digest = training_digest(dataset)
    fresh = fresh_checkpoint(dataset)
    target = open_target(out, fresh, [GP], digest, options, dataset)
    target.add(GP, train_gps_on_maps(config, dataset, options))


def train_gps_on_maps(
    config: LatentGPConfig, dataset: TerrainDataset, options: FitOptions
) -> Part:
    """Train the GPs on the split `train`, and return them as a part of a checkpoint."""
    names = [item.name for item in dataset.recipe.classes]
    model = _fit_and_say(config, sum_split(dataset, TRAIN), names, options.device)
    has_truth = dataset.truth_of(VALID) == "generated"
    chunks = dataset.terrain_chunks(VALID)
    scores = measure_latent(model.tabulate(), chunks, has_truth)
    errors = "(errors unknown, since the true distribution of λ is unknown) "
    if has_truth:
        errors = (
            f"RMSE of the latent mean {scores['latent_rmse']:.4f}, largest error of "
            f"the noise {scores['noise_error']:.1%}, "
        )
    say(f"gp: validation {errors}NLL {scores['nll']:.4f}")
    metrics = {f"valid_{name}": value for name, value in scores.items()}
    return _part(model, options.seed, metrics, dataset.id, training_digest(dataset))


def _train_on_logs(
    data: str, out: str, config: LatentGPConfig, options: FitOptions
) -> None:
    """Train the GPs on slip logs, and save them in a checkpoint.

    If the checkpoint exists, its class names are used to read the logs.
    """
    checkpoint = existing(Path(out), options.overwrite)
    known_classes = checkpoint.class_names if checkpoint else ()
    names, cells, sha256, drive = read_slip_log(data, known_classes)
    sums = SlopeSums.of(cells, len(names))
    digest = f"file:{sha256}"
    target = open_target(out, Checkpoint(class_names=names), [GP], digest, options)
    counts = dict(zip(names, sums.count.tolist(), strict=True))
    rare = [f"{name} {count}" for name, count in counts.items() if count < _MIN_ROWS]
    if rare:
        replaced = ""
        if checkpoint and GP in checkpoint.parts:
            replaced = f". The GPs of these classes in {out} are replaced"
        tell(
            f"benchnav-train: warning: {data} has fewer than {_MIN_ROWS} rows of "
            f"{len(rare)} of {len(counts)} classes ({', '.join(rare)}); their GPs remain "
            f"close to the prior, which is vague{replaced}"
        )
    metrics = {}
    halves = _held_out(cells, drive, options.seed)
    if halves:
        training, held_out, description = halves
        training_sums = SlopeSums.of(training, len(names))
        preliminary = fit_gps(config, training_sums, options.device)
        metrics["held_out_nll"] = cell_nll(held_out, preliminary.tabulate())
        say(
            f"gp: NLL {metrics['held_out_nll']:.4f} on {len(held_out)} held-out rows, "
            f"{description}; training on all rows next"
        )
    model = _fit_and_say(config, sums, names, options.device)
    rows = ", ".join(f"{name} {count}" for name, count in counts.items())
    say(f"gp: training rows: {rows}")
    target.add(GP, _part(model, options.seed, metrics, Path(data).name, digest))


def _held_out(
    cells: Cells, drive: Tensor | None, seed: int
) -> tuple[Cells, Cells, str] | None:
    """Return training rows, held-out rows and a description; None if there are too few."""
    n_drives = 0 if drive is None else len(drive.unique())
    if drive is not None and n_drives > 1:
        mask = hold_out_drives(drive, _HELD_OUT, seed)
        n_held_out = len(drive[mask].unique())
        description = f"all of {n_held_out} of {n_drives} drives"
        return cells.select(~mask), cells.select(mask), description
    if int(cells.class_id.bincount().max()) < 1 / _HELD_OUT:
        return None
    training, held_out = hold_out(cells, _HELD_OUT, seed)
    return training, held_out, "which follow one another in each class"


def _fit_and_say(
    config: LatentGPConfig, sums: SlopeSums, class_names: Sequence[str], device: Device
) -> LatentGPs:
    """Train the GPs, and print which classes have a second mode."""
    model = fit_gps(config, sums, device)
    if model.soft:
        modes = zip(class_names, *(v.tolist() for v in model.soft), strict=True)
        soft_spots = [
            f"{name} {weight:.1%} of N({mean:.3f}, {std:.3f})"
            for name, weight, mean, std in modes
            if weight
        ]
        say(f"gp: soft spots of {', '.join(soft_spots)}")
    return model


def _part(
    model: LatentGPs,
    seed: int,
    metrics: dict[str, float],
    data_id: str,
    data_digest: str,
) -> Part:
    return Part(
        config={**asdict(model.config), "steepest_deg": model.steepest_deg},
        tensors=model.to_tensors(),
        seed=seed,
        metrics=metrics,
        data_id=data_id,
        data_digest=data_digest,
    )
