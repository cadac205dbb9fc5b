"""Training the class-wise GPs of a fused model, on maps or on a robot's slip logs."""

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
from benchnav.models.checkpoint import GP, Checkpoint, Part
from benchnav.models.config import LatentGPConfig, check_seed
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
from benchnav.models.slope_gp.slip_logs import read_slip_logs
from benchnav.models.slope_gp.soft_modes import find_soft_modes
from benchnav.models.training.data import TRAIN, VALID, open_dataset, training_digest
from benchnav.models.training.fit import FitOptions, fit, say
from benchnav.models.training.target import existing, fresh_checkpoint, open_target

_HELD_OUT = 0.1  # of slip logs
_FEW_ROWS = 10  # of a class in slip logs


def fit_gps(
    config: LatentGPConfig, sums: SlopeSums, device: Device = "cpu"
) -> LatentGPs:
    """Trains the class-wise GPs on sums over cells, in float64 on one device; nothing
    is drawn.

    Args:
        config: what to train.
        sums: of the cells of all classes, from maps or from a robot's logs.
        device: where to train.

    Returns:
        The GPs, on the CPU.
    """
    censored = config.likelihood == "censored"
    if config.second_component and censored:
        soft, bins = find_soft_modes(sums)
    else:
        soft, bins = None, sums.bins(censored)
    model = LatentGPs(config, sums.steepest_deg, soft)
    # All cells are in each batch. A generator of its own keeps the loader from drawing
    # on PyTorch's global one.
    batches: Any = [bins] * config.epoch_steps
    loader = DataLoader(batches, batch_size=None, generator=torch.Generator())
    data = {"train_dataloaders": loader}
    fit(
        model,
        GP,
        FitOptions(device=device),
        {},
        [],
        data,
        max_epochs=config.epochs,
        precision="64-true",
    )
    return model.cpu().eval()


def train_gps(data: str, out: str, config: LatentGPConfig, options: FitOptions) -> None:
    """Trains the GPs on a dataset or on slip logs, into a checkpoint.

    Args:
        data: path or id of a dataset, or path of slip logs.
        out: folder of the checkpoint.
        config: what to train.
        options: how to train.
    """
    check_seed(options.seed)
    if data.endswith(ENDINGS):
        _train_on_logs(data, out, config, options)
        return
    dataset = open_dataset(data)
    target = open_target(
        out, fresh_checkpoint(dataset), [GP], training_digest(dataset), options, dataset
    )
    target.add(GP, train_gps_on_maps(config, dataset, options))


def train_gps_on_maps(
    config: LatentGPConfig, dataset: TerrainDataset, options: FitOptions
) -> Part:
    """Trains the GPs on the split `train` and gives them as a part of a checkpoint."""
    names = [item.name for item in dataset.recipe.classes]
    model = _fit_and_say(config, sum_split(dataset, TRAIN), names, options.device)
    known = dataset.truth_of(VALID) == "generated"
    found = measure_latent(model.tabulate(), dataset.terrain_chunks(VALID), known)
    errors = (
        f"RMSE of the latent mean {found['latent_rmse']:.4f}, largest error of the "
        f"noise {found['noise_error']:.1%}, "
        if known
        else "(errors unknown, since the true distribution of λ of this ground is "
        "unknown) "
    )
    say(f"gp: validation {errors}NLL {found['nll']:.4f}")
    metrics = {f"valid_{name}": value for name, value in found.items()}
    return _part(model, options.seed, metrics, dataset.id, training_digest(dataset))


def _train_on_logs(
    data: str, out: str, config: LatentGPConfig, options: FitOptions
) -> None:
    """Trains the GPs on slip logs, into a checkpoint, whose class table the logs are
    read with if it is there.
    """
    there = existing(Path(out), options.overwrite)
    names, cells, sha256, drive = read_slip_logs(
        data, there.class_names if there else ()
    )
    sums, digest = SlopeSums.of(cells, len(names)), f"file:{sha256}"
    target = open_target(out, Checkpoint(class_names=names), [GP], digest, options)
    counts = dict(zip(names, sums.count.tolist(), strict=True))
    if few := [
        f"{name} {count}" for name, count in counts.items() if count < _FEW_ROWS
    ]:
        lost = (
            f"; the GPs that {out} held for them are dropped"
            if there and GP in there.parts
            else ""
        )
        tell(
            f"benchnav-train: warning: {data} has fewer than {_FEW_ROWS} rows of "
            f"{len(few)} of {len(counts)} classes "
            f"({', '.join(few)}); their GPs stay close to the prior, which is "
            f"vague{lost}"
        )
    metrics = {}
    if measured_on := _held_out(cells, drive, options.seed):
        kept, held, whose = measured_on
        trial = fit_gps(config, SlopeSums.of(kept, len(names)), options.device)
        metrics["held_out_nll"] = cell_nll(held, trial.tabulate())
        say(
            f"gp: NLL {metrics['held_out_nll']:.4f} on {len(held)} held-out rows, "
            f"{whose}; training on all rows next"
        )
    model = _fit_and_say(config, sums, names, options.device)
    say(
        "gp: training rows: "
        f"{', '.join(f'{name} {count}' for name, count in counts.items())}"
    )
    target.add(GP, _part(model, options.seed, metrics, Path(data).name, digest))


def _held_out(
    cells: Cells, drive: Tensor | None, seed: int
) -> tuple[Cells, Cells, str] | None:
    """Rows to learn from, rows to measure on, and which these are; None where there are
    too few.
    """
    if drive is not None and (drives := len(drive.unique())) > 1:
        held = hold_out_drives(drive, _HELD_OUT, seed)
        return (
            cells.select(~held),
            cells.select(held),
            f"all of {len(drive[held].unique())} of {drives} drives",
        )
    if int(cells.class_id.bincount().max()) < 1 / _HELD_OUT:
        return None
    return *hold_out(cells, _HELD_OUT, seed), "which follow one another in each class"


def _fit_and_say(
    config: LatentGPConfig, sums: SlopeSums, class_names: Sequence[str], device: Device
) -> LatentGPs:
    """Trains the GPs, and names the classes that were found to have a second mode."""
    model = fit_gps(config, sums, device)
    if soft := model.soft:
        modes = zip(class_names, *(values.tolist() for values in soft), strict=True)
        found = [
            f"{name} {share:.1%} of N({mean:.3f}, {std:.3f})"
            for name, share, mean, std in modes
            if share
        ]
        say(f"gp: soft spots of {', '.join(found)}")
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
