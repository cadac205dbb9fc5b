"""Time of creating and reading datasets, compared with plain h5py on the same maps.

    python -m benchmarks.datasets

Creation is timed from the call to the closed file, and includes solvable test maps and
their reference times. Reading is that of a training epoch from 2 000 shards, with
rotated and mirrored maps, in one process of one thread. Its seconds are CPU time, with
the files in the page cache.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import torch

from benchmarks.timing import per_second, seconds, show
from benchnav.datagen import Recipe, TerrainDataset, generate, load_recipe
from benchnav.datagen.files.create import create
from benchnav.datagen.recipe.recipe import Split
from benchnav.models.training.data import MapDataset
from benchnav.models.training.map_order import MapSampler

READS, SHARDS, MAPS_A_SHARD = 3000, 2000, 10
FIELDS = ("rgb", "class_id")


def make(recipe: Recipe, path: Path, jobs: int = 2, shard_cells: int = 0) -> None:
    """Create a dataset."""
    for _ in create(recipe, path, jobs=jobs, overwrite=True, shard_cells=shard_cells):
        pass


def write_plainly(recipe: Recipe, path: Path) -> None:
    """Write the same maps without this package, through HDF5's own filters."""
    with h5py.File(path, "w") as file:
        for split, spec in recipe.splits.items():
            for name, values in generate(recipe, split, np.arange(spec.maps)).items():
                chunk = (1, *values.shape[1:]) if values.ndim > 2 else values.shape
                file.create_dataset(
                    f"{split}/{name}",
                    data=values,
                    chunks=chunk,
                    compression="gzip",
                    shuffle=True,
                    fletcher32=True,
                )


def time_making(folder: Path) -> None:
    """Print the number of maps of `paper-v1` created per second."""
    recipe = load_recipe("paper-v1")
    works = {
        "generate, h5py's own filters": lambda: write_plainly(
            recipe, folder / "plain.h5"
        ),
        "create, one worker": lambda: make(recipe, folder / "made.h5", 1),
        "create, two workers": lambda: make(recipe, folder / "made.h5", 2),
    }
    total = sum(split.maps for split in recipe.splits.values())
    show(
        [
            {"maps/s": name, **per_second(total, seconds(work, 7))}
            for name, work in works.items()
        ]
    )


def make_shards(path: Path) -> None:
    """Create 20 000 maps of 32 × 32 cells in 2 000 files."""
    paper = load_recipe("paper-v1")
    splits = {"train": Split(scenario="std", maps=SHARDS * MAPS_A_SHARD)}
    small = {"height": 32, "width": 32, "start_m": (4.0, 4.0), "goal_m": (12.0, 12.0)}
    recipe = replace(
        paper,
        id="shards",
        class_periods_m=(6.0, 3.0, 1.5),
        splits=splits,
        scenarios={"std": paper.scenarios["std"]},
        **small,
    )
    make(recipe, path, shard_cells=MAPS_A_SHARD * 32 * 32)


def time_reading(folder: Path) -> None:
    """Print the speed of reading an epoch in any order and in windows of shards.

    The peer opens a file for each map.
    """
    torch.set_num_threads(1)
    make_shards(folder / "shards")
    pieces = TerrainDataset(folder / "shards").pieces["train"]
    maps = MapDataset(folder / "shards", "train", FIELDS)

    def plainly() -> None:
        for index in np.random.default_rng(0).integers(len(maps), size=READS).tolist():
            with h5py.File(pieces[index // MAPS_A_SHARD].path) as file:
                for name in FIELDS:
                    file["train"][name][index % MAPS_A_SHARD]

    def epoch(shards: tuple[int, ...]) -> None:
        for key in MapSampler(
            len(maps), 16, symmetries=tuple(range(8)), shuffle=True, shards=shards
        ):
            maps[key]

    windows = tuple(piece.maps for piece in pieces)
    works = {
        "h5py, any order, file opened each time": (READS, plainly),
        "batches of training, any order": (len(maps), lambda: epoch(())),
        "batches of training, windows of shards": (len(maps), lambda: epoch(windows)),
    }
    clock = time.process_time
    show(
        [
            {"maps/s": name, **per_second(count, seconds(work, 3, clock))}
            for name, (count, work) in works.items()
        ]
    )


def main() -> None:
    """Print both tables."""
    with tempfile.TemporaryDirectory() as folder:
        time_making(Path(folder))
        time_reading(Path(folder))


if __name__ == "__main__":
    main()
