"""Speed of the class-wise Gaussian processes, next to an exact GP in the same run.

    python benchmarks/gps.py [DATASET]

Without a dataset, paper-v1 is made in a temporary folder. The exact GP is GPyTorch's, with the plain
Gaussian likelihood, on 2 000 cells a class, its hyper-parameters learned by 50 steps of Adam; three
steps of one class are timed and the rest is extrapolated.
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
from gpytorch.distributions import MultivariateNormal
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import load_recipe
from benchnav.models.config import LatentGPConfig
from benchnav.models.slope_gp.cells import Cells, read_cells, sum_split
from benchnav.models.training.gaussian_processes import fit_gps

REPEATS = 5
EXACT_CELLS, EXACT_STEPS, EXACT_TIMED = 2000, 50, 3


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
