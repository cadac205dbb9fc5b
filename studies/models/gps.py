"""Errors of the class-wise Gaussian processes, given the true class of each cell.

The classifier affects none of these numbers. Other priors than the default are compared
too, fitted to all slopes and to flat terrain only. This shows how much of a prediction
for steeper terrain comes from the prior.
"""

import contextlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchnav import Terrain, TraversabilityMixture
from benchnav.core import rng
from benchnav.core.settings import of, read
from benchnav.datagen import TerrainClass, TerrainDataset
from benchnav.datagen.recipe.latent import latent_mean, latent_std
from benchnav.models.config import LatentGPConfig
from benchnav.models.quality.scores import coverage, pit
from benchnav.models.slope_gp.cells import SlopeSums, read_cells, sum_cells, sum_split
from benchnav.models.slope_gp.table import SlopeTable
from benchnav.models.training.gaussian_processes import fit_gps
from studies.study import Rows, Work

LEAST_CELLS = 200
EDGE_DEG = 12.0
BEYOND_DEG = (5.0, 10.0)
BANDS_DEG = ((0, 10), (10, 15), (15, 18), (18, 21), (21, 24), (24, 27), (27, 90))


def distributions(
    table: SlopeTable, terrain: Terrain
) -> tuple[TraversabilityMixture, TraversabilityMixture]:
    """Return the predicted and the true distributions of λ, given the true classes."""
    predicted = table.predict_by_class(terrain.class_id, terrain.slope_deg.double())
    truth = [
        v.double()
        for v in (terrain.truth.weights, terrain.truth.means, terrain.truth.stds)
    ]
    return predicted, TraversabilityMixture(*truth)


def errors(table: SlopeTable, dataset: TerrainDataset) -> Rows:
    """Return a row per class: RMSE of E[λ] over bins of 1°, relative error of noise.

    Cells are those of the validation maps; bins need `LEAST_CELLS` cells or more.
    """
    terrain = dataset.terrain("valid")
    predicted, true = distributions(table, terrain)
    gap = predicted.mean() - true.mean()
    rows = []
    for index, kind in enumerate(dataset.recipe.classes):
        is_class = terrain.class_id == index
        bins = terrain.slope_deg[is_class].long()
        cells = bins.bincount()
        means = bins.bincount(gap[is_class]) / cells.clamp(min=1)
        rmse = means[cells >= LEAST_CELLS].square().mean().sqrt()
        noise = float(table.noise_std[index]) / kind.noise - 1
        rows.append(
            {
                "class": kind.name,
                "RMSE of E[λ] over bins of 1°": f"{rmse:.4f}",
                "error of the noise": f"{noise:+.1%}",
            }
        )
    return rows


def scores(table: SlopeTable, dataset: TerrainDataset, split: str) -> dict[str, str]:
    """Return NLL and CRPS of a split."""
    terrain = dataset.terrain(split)
    predicted, _ = distributions(table, terrain)
    observed = terrain.traversability.double()
    nll, crps = -predicted.log_prob(observed).mean(), predicted.crps(observed).mean()
    return {"split": split, "NLL": f"{nll:.5f}", "CRPS": f"{crps:.5f}"}


def bands(table: SlopeTable, dataset: TerrainDataset, split: str) -> Rows:
    """Return the coverage of predicted central 90 % intervals, by slope."""
    terrain = dataset.terrain(split)
    predicted, _ = distributions(table, terrain)
    draws = rng.generator(rng.stream_key(0, "benchmarks", split))
    transformed = pit(predicted, terrain.traversability.double(), draws)
    rows = []
    for low, high in BANDS_DEG:
        is_between = (terrain.slope_deg >= low) & (terrain.slope_deg < high)
        covered = f"{coverage(transformed[is_between]):.1%}"
        rows.append(
            {
                "slope": f"{low}–{high}°",
                "cells": int(is_between.sum()),
                "coverage of 90 %": covered,
            }
        )
    return rows


def prior_error(
    table: SlopeTable, classes: tuple[TerrainClass, ...], low: float, high: float
) -> str:
    """Return RMSE and bias of E[λ] over all classes and a uniform grid of slopes.

    The grid runs from `low` to `high` degrees in steps of 0.1°.
    """
    slopes = torch.arange(low, high, 0.1, dtype=torch.float64).expand(len(classes), -1)
    ids = torch.arange(len(classes)).unsqueeze(1).expand_as(slopes)
    mean = torch.from_numpy(latent_mean(ids.numpy(), slopes.numpy(), classes))[None]
    std = torch.from_numpy(latent_std(ids.numpy(), classes))[None]
    true = TraversabilityMixture(torch.ones_like(mean), mean, std)
    gap = table.predict_by_class(ids[None], slopes[None]).mean() - true.mean()
    return f"{gap.square().mean().sqrt():.4f} ({gap.mean():+.4f})"


def prior_table(
    changes: Sequence[dict[str, Any]],
    flat_sums: SlopeSums,
    all_sums: SlopeSums,
    classes: tuple[TerrainClass, ...],
) -> Rows:
    """Return errors under each prior, within the slopes of the data and beyond them."""
    near, far = (EDGE_DEG + beyond for beyond in BEYOND_DEG)
    rows = []
    for change in changes:
        all_table, flat_table = (
            fitted(sums, second_component=False, **change)
            for sums in (all_sums, flat_sums)
        )
        name = ", ".join(f"{key} {value}" for key, value in change.items()) or "default"
        row = {
            "prior": name,
            "all slopes: 0–12°": prior_error(all_table, classes, 0.0, EDGE_DEG),
        }
        for low, high in ((0.0, EDGE_DEG), (EDGE_DEG, near), (near, far)):
            row[f"slopes < 12°: {low:.0f}–{high:.0f}°"] = prior_error(
                flat_table, classes, low, high
            )
        rows.append(row)
    return rows


def fitted(sums: SlopeSums, **options: Any) -> SlopeTable:
    """Fit Gaussian processes to sums of cells; return their table over slopes."""
    with contextlib.redirect_stderr(io.StringIO()):
        return fit_gps(
            read(LatentGPConfig, options, of("the options")), sums
        ).tabulate()


def tables(
    work: Work, folder: Path, priors: Sequence[dict[str, Any]]
) -> dict[str, Rows]:
    """Return tables of errors by class, likelihoods, coverage by slope and priors."""
    dataset = TerrainDataset(work.maps_in / "paper-v1.h5")
    classes = dataset.recipe.classes
    sums = sum_split(dataset, "train")
    kinds = {kind: fitted(sums, likelihood=kind) for kind in ("censored", "gaussian")}
    flat = (
        cells.select(cells.slope_deg < EDGE_DEG)
        for cells in read_cells(dataset, "train")
    )
    cut = sum_cells(flat, len(classes))
    return {
        "classes": errors(kinds["censored"], dataset),
        "likelihoods": [
            {"likelihood": kind, **scores(table, dataset, split)}
            for kind, table in kinds.items()
            for split in ("test/std", "test/hg")
        ],
        "hg-flat": bands(fitted(cut), dataset, "test/hg"),
        "priors": prior_table(priors, cut, sums, classes),
    }
