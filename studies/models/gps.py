"""Errors of the class-wise Gaussian processes where each cell is read with its true class.

No number has to do with the classifier. Other priors than the default are tried too, on all slopes and on flat ground
only, to see how much of what is predicted of steeper terrain is the prior's.
"""

import contextlib
import io
from pathlib import Path
from typing import Any

import torch

from benchnav.core import rng
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.tables import Table
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.classes import TerrainClass
from benchnav.datagen.recipe.latent import latent_mean
from benchnav.models.config import LatentGPConfig
from benchnav.models.quality.scores import coverage, pit, tail_rate
from benchnav.models.slope_gp.cells import SlopeSums, read_cells, sum_cells, sum_split
from benchnav.models.slope_gp.table import SlopeTable
from benchnav.models.training.gaussian_processes import fit_gps
from studies.study import Work
from studies.tables import table as tabled

LEAST_CELLS = 200
EDGE_DEG = 12.0
BEYOND_DEG = (5.0, 10.0)
PRIORS: dict[str, dict[str, Any]] = {
    "default": {},
    "λ 0.3 on flat ground": {"prior_level": 0.3},
    "λ 0.8 on flat ground": {"prior_level": 0.8},
    "level: no fall with slope": {"prior_fall": 0.0},
    "fall of 0.06 a degree": {"prior_fall": 0.06},
    "fall known to 0.002 a degree": {"prior_fall_std": 0.002},
    "fall known to 0.05 a degree": {"prior_fall_std": 0.05},
    "spread of 0.1 at least": {"prior_std_range": (0.1, 1.0)},
    "length scale of 5° at most": {"length_deg": 4.0, "length_range_deg": (2.0, 5.0)},
    "length scale of 20° at most": {"length_range_deg": (2.0, 20.0)},
    "noise 0.4 before any data": {"noise_std": 0.4},
}
BANDS_DEG = ((0, 10), (10, 15), (15, 18), (18, 21), (21, 24), (24, 27), (27, 90))


def distributions(table: SlopeTable, terrain: Terrain) -> tuple[TraversabilityMixture, TraversabilityMixture]:
    """Predicted and true distribution of λ in each cell, its class known."""
    predicted = table.own(terrain.class_id, terrain.slope_deg.double())
    truth = [v.double() for v in (terrain.truth.weights, terrain.truth.means, terrain.truth.stds)]
    return predicted, TraversabilityMixture(*truth)


def errors(table: SlopeTable, dataset: TerrainDataset) -> tuple[list[float], list[float]]:
    """Of each class: RMSE of E[λ] over bins of 1° of the validation maps, relative error of the noise."""
    terrain = dataset.terrain("valid")
    predicted, true = distributions(table, terrain)
    gap = predicted.mean() - true.mean()
    found = []
    for c in range(len(dataset.recipe.classes)):
        here = terrain.class_id == c
        bins = terrain.slope_deg[here].long()
        cells = bins.bincount()
        means = bins.bincount(gap[here]) / cells.clamp(min=1)
        found.append(float(means[cells >= LEAST_CELLS].square().mean().sqrt()))
    noise = [float(s) / c.noise - 1 for s, c in zip(table.noise_std, dataset.recipe.classes, strict=True)]
    return found, noise


def bands(table: SlopeTable, dataset: TerrainDataset, split: str) -> Table:
    """Return how good predictions are, by slope."""
    terrain = dataset.terrain(split)
    predicted, true = distributions(table, terrain)
    observed = terrain.traversability.double()
    gap = predicted.mean() - true.mean()
    latent = predicted.means[:, 0] - true.means[:, 0]
    transformed = pit(predicted, observed, rng.generator(rng.stream_key(0, "benchmarks", split)))
    rows = []
    for low, high in BANDS_DEG:
        here = (terrain.slope_deg >= low) & (terrain.slope_deg < high)
        if int(here.sum()) < 5:
            continue
        rows.append((
            f"{low}–{high}°", f"{int(here.sum()):,}", f"{gap[here].mean():+.3f}",
            f"{latent[here].square().mean().sqrt():.3f}", f"{coverage(transformed[here]):.1%}",
            f"{tail_rate(transformed[here]):.1%}",
        ))  # fmt: skip
    return tabled(
        ("slope", "cells", "bias of E[λ]", "latent RMSE", "coverage of 90 %", "under VaR 10 %"), rows
    )


def prior_errors(
    table: SlopeTable, classes: tuple[TerrainClass, ...], low: float, high: float
) -> tuple[float, float]:
    """RMSE and bias of E[λ] over all classes and slopes in a range, every tenth of a degree alike."""
    slopes = torch.arange(low, high, 0.1, dtype=torch.float64)
    ids = torch.arange(len(classes)).unsqueeze(1).expand(-1, len(slopes))
    slopes = slopes.expand(len(classes), -1)
    true = torch.from_numpy(latent_mean(ids.numpy(), slopes.numpy(), classes))
    noise = torch.tensor([item.noise for item in classes], dtype=torch.float64).unsqueeze(1).expand_as(true)
    pairs = [(true, noise), (table.own(ids, slopes).means[0], table.own(ids, slopes).stds[0])]
    expected = [
        TraversabilityMixture(torch.ones_like(mean)[None], mean[None], std[None]).mean()
        for mean, std in pairs
    ]
    gap = expected[1] - expected[0]
    return float(gap.square().mean().sqrt()), float(gap.mean())


def priors(short: SlopeSums, whole: SlopeSums, classes: tuple[TerrainClass, ...]) -> Table:
    """Return how much of what is predicted is the prior's, within the slopes of the data and beyond."""
    near, far = (EDGE_DEG + beyond for beyond in BEYOND_DEG)
    ranges = [(0.0, EDGE_DEG), (EDGE_DEG, near), (near, far)]
    rows = []
    for name, change in PRIORS.items():
        tables = [fitted(sums, second_component=False, **change) for sums in (whole, short)]
        errors = [prior_errors(tables[0], classes, *ranges[0])]
        errors += [prior_errors(tables[1], classes, *ends) for ends in ranges]
        rows.append((name, *(f"{rmse:.4f} ({bias:+.4f})" for rmse, bias in errors)))
    columns = (f"slopes < 12°: {low:.0f}–{high:.0f}°" for low, high in ranges)
    return tabled(("prior", "all slopes: 0–12°", *columns), rows)


def fitted(sums: SlopeSums, **options: Any) -> SlopeTable:
    """Return the table of Gaussian processes that were fitted to sums."""
    with contextlib.redirect_stderr(io.StringIO()):
        return fit_gps(LatentGPConfig(**options), sums).tabulate()


def tables(work: Work, folder: Path) -> dict[str, Table]:
    """Return errors by class, scores of two likelihoods, errors by slope, and those of other priors."""
    dataset = TerrainDataset(work.maps_in / "paper-v1.h5")
    classes = dataset.recipe.classes
    sums = sum_split(dataset, "train")
    kinds = {kind: fitted(sums, likelihood=kind) for kind in ("censored", "gaussian")}
    flat = (cells.select(cells.slope_deg < EDGE_DEG) for cells in read_cells(dataset, "train"))
    cut = sum_cells(flat, len(classes))
    rmse, noise = errors(kinds["censored"], dataset)
    by_class = [(c.name, f"{a:.4f}", f"{b:+.1%}") for c, a, b in zip(classes, rmse, noise, strict=True)]
    likelihoods = []
    for kind, gps in kinds.items():
        for split in ("test/std", "test/hg"):
            terrain = dataset.terrain(split)
            predicted, _ = distributions(gps, terrain)
            observed = terrain.traversability.double()
            scores = -predicted.log_prob(observed).mean(), predicted.crps(observed).mean()
            likelihoods.append((kind, split, *(f"{float(score):.5f}" for score in scores)))
    return {
        "classes": tabled(("class", "RMSE of E[λ] over bins of 1°", "error of the noise"), by_class),
        "likelihoods": tabled(("likelihood", "split", "NLL", "CRPS"), likelihoods, 2),
        "std": bands(kinds["censored"], dataset, "test/std"), "hg": bands(kinds["censored"], dataset, "test/hg"),
        "hg-flat": bands(fitted(cut), dataset, "test/hg"), "priors": priors(cut, sums, classes),
    }  # fmt: skip
