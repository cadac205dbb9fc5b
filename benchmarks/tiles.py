"""How long a large map takes tile by tile, and how much memory: that of the whole process at its most.

    python benchmarks/tiles.py                       # 4096 × 4096 cells, the shipped checkpoint stakes-v1
    python benchmarks/tiles.py paper-v1 2048 512     # another checkpoint, side of the map and of a tile

The map is laid out of shipped maps, drawn at random. What is written is its CVaR at level 0.9 and its mean. Times are
those of one core.
"""

import resource
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchnav import Grid, Observation
from benchnav.datagen import TerrainDataset, find_dataset
from benchnav.models import load_model, measure_margin, write_risk_maps

MEASURES: dict[str, Callable[[Any], Tensor]] = {
    "cvar:0.9": lambda distribution: distribution.cvar(0.9),
    "mean": lambda distribution: distribution.mean(),
}


def peak_gib() -> float:
    # The kernel counts kilobytes on Linux and bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def large_map(name: str, side: int) -> Observation:
    dataset = TerrainDataset(find_dataset(f"{name}-test"))
    split = next(iter(dataset.splits))
    maps = dataset.terrain(split).observe()
    count = -(-side // dataset.grid.height)
    drawn = torch.randint(len(maps.rgb), (count, count), generator=torch.Generator().manual_seed(0))

    def lay_out(layer: Tensor) -> Tensor:
        rows = [torch.cat([layer[i] for i in row.tolist()], -1) for row in drawn]
        return torch.cat(rows, -2)[None, ..., :side, :side].contiguous()

    layers = (lay_out(layer) for layer in (maps.rgb, maps.elevation_m, maps.slope_deg))
    return Observation(*layers, Grid(side, side, dataset.grid.resolution_m))


def main(name: str = "stakes-v1", side: str = "4096", tile: str = "1024") -> None:
    torch.set_num_threads(1)
    table = Table("work", "time", "peak memory", title=f"{name}, {side} × {side} cells, tiles of {tile}")
    model = load_model(name)
    table.add_row("imports and the checkpoint", "", f"{peak_gib():.2f} GiB")
    observation = large_map(name, int(side))
    table.add_row("the map", "", f"{peak_gib():.2f} GiB")
    start = time.process_time()
    margin = measure_margin(model, observation)
    took = time.process_time() - start
    table.add_row(f"measure_margin: {margin} cells", f"{took:.1f} s", f"{peak_gib():.2f} GiB")
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        write_risk_maps(model, observation, MEASURES, folder, int(tile), margin)
        took = time.process_time() - start
        table.add_row("write_risk_maps: CVaR and mean", f"{took:.1f} s", f"{peak_gib():.2f} GiB")
    Console().print(table)


if __name__ == "__main__":
    main(*sys.argv[1:])
