"""How fast and how good the class-wise Gaussian processes are, beside an exact GP in the same run.

    python benchmarks/gps.py [DATASET]

Without a dataset, paper-v1 is made in a temporary folder. The exact GP is GPyTorch's, with the plain
Gaussian likelihood, on 2 000 cells a class, its hyper-parameters learned by 50 steps of Adam; three
steps of one class are timed and the rest is extrapolated. All cells are read with their true class,
so that no figure has to do with the classifier.
"""

import contextlib
import io
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import gpytorch
import torch
from benchnav.models.pixels import PixelTable, read_pixels
from gpytorch.distributions import MultivariateNormal
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchnav import rng
from benchnav.datagen.create import create
from benchnav.datagen.scenario import load_recipe
from benchnav.datagen.store import TerrainDataset
from benchnav.mixture import TraversabilityMixture
from benchnav.models.config import LatentGPConfig
from benchnav.models.scores import coverage, crps, pit, tail_rate
from benchnav.models.slope_table import SlopeTable
from benchnav.models.training import fit_gps
from benchnav.terrain import Terrain

REPEATS = 5
EXACT_CELLS, EXACT_STEPS, EXACT_TIMED = 2000, 50, 3
LEAST_CELLS = 200
EDGE_DEG = 12.0
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


def exact_seconds(table: PixelTable) -> float:
    """Seconds that exact GPs of all classes would take."""
    count = min(EXACT_CELLS, int(table.count[0]))
    rows = torch.randperm(int(table.count[0]), generator=torch.Generator().manual_seed(0))[:count]
    model = ExactGP((table.slope_deg[0, rows, None] / 10).double(), table.traversability[0, rows].double())
    evidence = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1)

    def step() -> None:
        optimizer.zero_grad()
        (-evidence(model(*model.train_inputs), model.train_targets)).backward()
        optimizer.step()

    step()
    return median(seconds(step, EXACT_TIMED)) * EXACT_STEPS * len(table.count)


def distributions(table: SlopeTable, terrain: Terrain) -> tuple[TraversabilityMixture, TraversabilityMixture]:
    """Predicted and true distribution of λ in each cell, its class known."""
    own = terrain.class_id.unsqueeze(1)
    mean, std = (values.gather(1, own).double() for values in table.lookup(terrain.slope_deg))
    truth = (v.double() for v in (terrain.truth.weights, terrain.truth.means, terrain.truth.stds))
    return TraversabilityMixture(torch.ones_like(mean), mean, std), TraversabilityMixture(*truth)


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
    latent = predicted.means.squeeze(1) - true.means.squeeze(1)
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


def measure(dataset: TerrainDataset, console: Console) -> None:
    table = read_pixels(dataset, "train")
    times = seconds(lambda: fit_gps(LatentGPConfig(), table), REPEATS)
    exact = exact_seconds(table)
    speed = Table(
        "work", "seconds", "ratio", title=f"{len(table.count)} classes, {int(table.count.max()):,} cells each"
    )
    speed.add_row(
        f"exact GPs, {EXACT_CELLS:,} cells each, {EXACT_STEPS} steps", f"{exact:.0f} (extrapolated)", "1"
    )
    speed.add_row(
        "fit_gps", f"{median(times):.2f} ({min(times):.2f}–{max(times):.2f})", f"{exact / median(times):.0f}"
    )
    console.print(speed)

    tables = {}
    with contextlib.redirect_stderr(io.StringIO()):
        for kind in ("censored", "gaussian"):
            tables[kind] = fit_gps(LatentGPConfig(likelihood=kind), table).tabulate()  # type: ignore[arg-type]
        ids, slopes, values = (
            torch.from_numpy(v)
            for v in dataset.read("train", fields=("class_id", "slope_deg", "traversability")).values()
        )
        flat = slopes < EDGE_DEG
        cut = PixelTable.group(ids[flat], slopes[flat], values[flat], len(table.count))
        short = fit_gps(LatentGPConfig(), cut).tabulate()

    rmse, noise = errors(tables["censored"], dataset)
    classes = Table(
        "class", "RMSE of E[λ] over bins of 1°", "error of the noise", title="valid, true classes"
    )
    for item, one, other in zip(dataset.recipe.classes, rmse, noise, strict=True):
        classes.add_row(item.name, f"{one:.4f}", f"{other:+.1%}")
    console.print(classes)

    likelihoods = Table(
        "likelihood", "split", "NLL", "CRPS", title="scored as clipped Gaussians, true classes"
    )
    for kind, gps in tables.items():
        for split in ("test/std", "test/hg"):
            terrain = dataset.terrain(split)
            predicted, _ = distributions(gps, terrain)
            observed = terrain.traversability.double()
            nll = -float(predicted.log_prob(observed).mean())
            likelihoods.add_row(kind, split, f"{nll:.4f}", f"{float(crps(predicted, observed).mean()):.5f}")
    console.print(likelihoods)
    for split in ("test/std", "test/hg"):
        console.print(show_bands(tables["censored"], dataset, split, f"{split}, trained on all slopes"))
    console.print(show_bands(short, dataset, "test/hg", f"test/hg, trained on slopes under {EDGE_DEG:.0f}°"))


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
