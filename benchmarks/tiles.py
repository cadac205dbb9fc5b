"""Time and peak memory of the process that predicts a large map tile by tile.

    python -m benchmarks.tiles                       # 4096 × 4096 cells, the shipped checkpoint stakes-v1
    python -m benchmarks.tiles paper-v1 2048 512     # another checkpoint, side of the map and of a tile

The map is a mosaic of shipped maps, drawn at random. Its CVaR at level 0.9 and its mean
are written. Times are those of one core.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from benchmarks.timing import peak_gib, show
from benchnav import Grid, Observation
from benchnav.datagen import TerrainDataset, find_dataset
from benchnav.models import load_model, measure_margin, write_risk_maps

MEASURES: dict[str, Callable[[Any], Tensor]] = {
    "cvar:0.9": lambda distribution: distribution.cvar(0.9),
    "mean": lambda distribution: distribution.mean(),
}


def large_map(name: str, side: int) -> Observation:
    """Return a mosaic of shipped maps, drawn at random."""
    dataset = TerrainDataset(find_dataset(f"{name}-test"))
    split = next(iter(dataset.splits))
    maps = dataset.terrain(split).observe()
    count = -(-side // dataset.grid.height)
    drawn = torch.randint(
        len(maps.rgb), (count, count), generator=torch.Generator().manual_seed(0)
    )

    def lay_out(layer: Tensor) -> Tensor:
        rows = [torch.cat([layer[i] for i in row.tolist()], -1) for row in drawn]
        return torch.cat(rows, -2)[None, ..., :side, :side].contiguous()

    layers = (lay_out(layer) for layer in (maps.rgb, maps.elevation_m, maps.slope_deg))
    return Observation(*layers, Grid(side, side, dataset.grid.resolution_m))


def main(name: str = "stakes-v1", side: str = "4096", tile: str = "1024") -> None:
    """Print the table."""
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []

    def measured(work: str, call: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = call()
        rows.append(
            {
                "work": work,
                "s": time.process_time() - start,
                "peak memory [GiB]": peak_gib(),
            }
        )
        return result

    model = measured("imports and the checkpoint", lambda: load_model(name))
    observation = measured("the map", lambda: large_map(name, int(side)))
    margin = measured("measure_margin", lambda: measure_margin(model, observation))
    with tempfile.TemporaryDirectory() as folder:
        measured(
            "write_risk_maps: CVaR and mean",
            lambda: write_risk_maps(
                model, observation, MEASURES, folder, int(tile), margin
            ),
        )
    print(f"{name}, {side} × {side} cells, tiles of {tile}, margin of {margin} cells")
    show(rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
