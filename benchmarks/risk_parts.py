"""What the time of a CVaR map is made of.

    python benchmarks/risk_parts.py

One thread, the first map of `hs` in `paper-v1-test` as the shipped model sees it: 64 × 64 cells of 10 components.
"""

import math

import torch
from engine import milliseconds
from rich.console import Console
from rich.table import Table

from benchnav.core import cvar
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.base import predict
from benchnav.models.predictor import load_model

LEVEL = 0.9


def main() -> None:
    torch.set_num_threads(1)
    dataset = TerrainDataset(find_dataset("paper-v1-test"))
    mixture = predict(load_model("paper-v1"), dataset.terrain("test/hs", [0]))
    flat = [values[0].flatten(1).double() for values in (mixture.weights, mixture.means, mixture.stds)]
    cells = cvar.Cells(flat[0], flat[1], math.sqrt(0.5) / flat[2])
    tail = torch.full_like(cells.means[0], 1 - LEVEL)
    root = cvar._first_root(cells, tail)
    parts = {
        "whole": lambda: mixture.cvar(LEVEL),
        "search for the VaR in float32": lambda: cvar._first_root(cells, tail),
        "F, its density and G at the VaR in float64": lambda: cells.around(root),
        "G at 0 in float64": lambda: cells.integral(0.0),
    }
    table = Table(f"CVaR of {cells.means.shape[1]} cells, {len(cells.means)} components, level {LEVEL}", "ms")
    for name, work in parts.items():
        table.add_row(name, f"{milliseconds(work, 101):.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
