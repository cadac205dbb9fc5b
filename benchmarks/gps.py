"""How fast and how good the class-wise Gaussian processes are, beside an exact GP in the same run.

    python benchmarks/gps.py [DATASET]

Without a dataset, paper-v1 is made in a temporary folder. The exact GP is GPyTorch's, with the plain
Gaussian likelihood, on 2 000 cells a class, its hyper-parameters learned by 50 steps of Adam; three
steps of one class are timed and the rest is extrapolated. All cells are read with their true class,
so that no figure has to do with the classifier. Last, other priors than the default are tried, on all
slopes and on flat ground alone, to see how much of what is predicted of steeper ground is the prior's.
"""

import contextlib
import io
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import gpytorch
import torch
from gpytorch.distributions import MultivariateNormal
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchnav.core import rng
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.classes import TerrainClass
from benchnav.datagen.recipe.latent import latent_mean
from benchnav.datagen.recipe.recipe import load_recipe
from benchnav.models.config import LatentGPConfig
from benchnav.models.quality.scores import coverage, pit, tail_rate
from benchnav.models.slope_gp.cells import Cells, SlopeSums, read_cells, sum_cells, sum_split
from benchnav.models.slope_gp.table import SlopeTable
from benchnav.models.training.gaussian_processes import fit_gps

REPEATS = 5
EXACT_CELLS, EXACT_STEPS, EXACT_TIMED = 2000, 50, 3
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


class ExactGP(gpytorch.models.ExactGP):
    """GPyTorch's exact GP with a constant mean and a Matérn 5/2 kernel."""

    def __init__(self, slope: Tensor, observed: Tensor) -> None:
        super().__init__(slope, observed, gpytorch.likelihoods.GaussianLikelihood())
        self.mean = gpytorch.means.ConstantMean()
        self.kernel = gpytorch.kernels.ScaleKernel(gpytorch.kernels.MaternKernel(nu=2.5))
        self.double()

    def forward(self, x: Tensor) -> MultivariateNormal:
        return MultivariateNormal(self.mean(x), self.kernel(x))


def seconds(work: Callable[[], object], repeats: int) -> list[float]:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        with contextlib.redirect_stderr(io.StringIO()):
            work()
        times.append(time.perf_counter() - start)
    return times


def shown_seconds(times: list[float]) -> str:
    return f"{median(times):.2f} ({min(times):.2f}–{max(times):.2f})"


def exact_seconds(cells: Cells, classes: int) -> float:
    """Seconds that exact GPs of all classes would take."""
    first = cells.select(cells.class_id == 0)
    rows = torch.randperm(len(first), generator=torch.Generator().manual_seed(0))[:EXACT_CELLS]
    model = ExactGP((first.slope_deg[rows, None] / 10).double(), first.traversability[rows].double())
    evidence = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1)

    def step() -> None:
        optimizer.zero_grad()
        (-evidence(model(*model.train_inputs), model.train_targets)).backward()
        optimizer.step()

    step()
    return median(seconds(step, EXACT_TIMED)) * EXACT_STEPS * classes


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


def show_bands(table: SlopeTable, dataset: TerrainDataset, split: str, title: str) -> Table:
    """How good predictions are, by slope."""
    terrain = dataset.terrain(split)
    predicted, true = distributions(table, terrain)
    observed = terrain.traversability.double()
    gap = predicted.mean() - true.mean()
    latent = predicted.means[:, 0] - true.means[:, 0]
    transformed = pit(predicted, observed, rng.generator(rng.stream_key(0, "benchmarks", split)))
    shown = Table(
        "slope", "cells", "bias of E[λ]", "latent RMSE", "coverage of 90 %", "under VaR 10 %", title=title
    )
    for low, high in BANDS_DEG:
        here = (terrain.slope_deg >= low) & (terrain.slope_deg < high)
        if int(here.sum()) < 5:
            continue
        shown.add_row(
            f"{low}–{high}°",
            f"{int(here.sum()):,}",
            f"{float(gap[here].mean()):+.3f}",
            f"{float(latent[here].square().mean().sqrt()):.3f}",
            f"{coverage(transformed[here]):.1%}",
            f"{tail_rate(transformed[here]):.1%}",
        )
    return shown


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


def show_priors(short: SlopeSums, whole: SlopeSums, classes: tuple[TerrainClass, ...]) -> Table:
    """How much of what is predicted hangs on the prior, within the slopes of the data and beyond."""
    near, far = (EDGE_DEG + beyond for beyond in BEYOND_DEG)
    ranges = [(0.0, EDGE_DEG), (EDGE_DEG, near), (near, far)]
    shown = Table(
        "prior", "all slopes: 0–12°", *(f"slopes < 12°: {low:.0f}–{high:.0f}°" for low, high in ranges),
        title="E[λ]: RMSE (bias), main modes",
    )  # fmt: skip
    for name, change in PRIORS.items():
        config = LatentGPConfig(second_component=False, **change)
        with contextlib.redirect_stderr(io.StringIO()):
            tables = [fit_gps(config, sums).tabulate() for sums in (whole, short)]
        found = [prior_errors(tables[0], classes, *ranges[0])]
        found += [prior_errors(tables[1], classes, *both) for both in ranges]
        shown.add_row(name, *(f"{rmse:.4f} ({bias:+.4f})" for rmse, bias in found))
    return shown


def measure(dataset: TerrainDataset, console: Console) -> None:
    classes = dataset.recipe.classes
    reading = seconds(lambda: sum_split(dataset, "train"), REPEATS)
    sums = sum_split(dataset, "train")
    times = seconds(lambda: fit_gps(LatentGPConfig(second_component=False), sums), REPEATS)
    both = seconds(lambda: fit_gps(LatentGPConfig(), sums), REPEATS)
    exact = exact_seconds(next(read_cells(dataset, "train")), len(classes))
    speed = Table(
        "work", "seconds", "ratio", title=f"{len(classes)} classes, {int(sums.count.sum()):,} cells in all"
    )
    speed.add_row(
        f"exact GPs, {EXACT_CELLS:,} cells each, {EXACT_STEPS} steps", f"{exact:.0f} (extrapolated)", "1"
    )
    speed.add_row("fit_gps, one mode a class", shown_seconds(times), f"{exact / median(times):.0f}")
    speed.add_row("fit_gps, looking for second modes", shown_seconds(both), f"{exact / median(both):.0f}")
    speed.add_row("reading and summing all cells", shown_seconds(reading), "")
    console.print(speed)

    tables = {}
    with contextlib.redirect_stderr(io.StringIO()):
        for kind in ("censored", "gaussian"):
            tables[kind] = fit_gps(LatentGPConfig(likelihood=kind), sums).tabulate()  # type: ignore[arg-type]
        flat = (cells.select(cells.slope_deg < EDGE_DEG) for cells in read_cells(dataset, "train"))
        cut = sum_cells(flat, len(classes))
        short = fit_gps(LatentGPConfig(), cut).tabulate()

    rmse, noise = errors(tables["censored"], dataset)
    by_class = Table(
        "class", "RMSE of E[λ] over bins of 1°", "error of the noise", title="valid, true classes"
    )
    for item, one, other in zip(classes, rmse, noise, strict=True):
        by_class.add_row(item.name, f"{one:.4f}", f"{other:+.1%}")
    console.print(by_class)

    likelihoods = Table(
        "likelihood", "split", "NLL", "CRPS", title="scored as clipped Gaussians, true classes"
    )
    for kind, gps in tables.items():
        for split in ("test/std", "test/hg"):
            terrain = dataset.terrain(split)
            predicted, _ = distributions(gps, terrain)
            observed = terrain.traversability.double()
            nll = -float(predicted.log_prob(observed).mean())
            likelihoods.add_row(kind, split, f"{nll:.4f}", f"{float(predicted.crps(observed).mean()):.5f}")
    console.print(likelihoods)
    for split in ("test/std", "test/hg"):
        console.print(show_bands(tables["censored"], dataset, split, f"{split}, trained on all slopes"))
    console.print(show_bands(short, dataset, "test/hg", f"test/hg, trained on slopes under {EDGE_DEG:.0f}°"))
    console.print(show_priors(cut, sums, classes))


def main() -> None:
    console = Console()
    if len(sys.argv) > 1:
        measure(TerrainDataset(sys.argv[1]), console)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "paper-v1.h5"
        for _ in create(load_recipe("paper-v1"), path, jobs=2):
            pass
        measure(TerrainDataset(path), console)


if __name__ == "__main__":
    main()
