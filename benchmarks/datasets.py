"""How fast datasets are made and read, beside plain h5py on the same maps in the same run.

    python benchmarks/datasets.py

    python benchmarks/datasets.py shards    # training batches from 2 000 shards alone

Making is timed from the call to the closed file, with solvable test maps and their reference times,
in an interpreter that has its imports done; the whole command is timed as well. Reading is random
maps, one at a time, in one process. From shards it is the batches of an epoch as training takes them, turned and
mirrored, in one process of one thread, and seconds are those of its core; the files lie in the page cache. Each figure
is the median of the repeats, with the range.
"""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median

import h5py
import numpy as np
from rich.console import Console
from rich.table import Table

from benchnav.datagen import schema
from benchnav.datagen.files.create import create
from benchnav.datagen.files.maps import TerrainMaps
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import Recipe, Split, load_recipe
from benchnav.datagen.synth.generate import generate

REPEATS = 7
READS = 3000
SHARDS = 2000
MAPS_A_SHARD = 10


def per_second(
    count: int,
    work: Callable[[], object],
    repeats: int = REPEATS,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[float, str]:
    """Times `count` maps of work; gives the median rate and the range as text."""
    rates = []
    for _ in range(repeats):
        start = clock()
        work()
        rates.append(count / (clock() - start))
    return median(rates), f"{median(rates):,.0f} ({min(rates):,.0f}–{max(rates):,.0f})"


def make(recipe: Recipe, path: Path, jobs: int) -> None:
    for _ in create(recipe, path, jobs=jobs, overwrite=True):
        pass


def write_plainly(recipe: Recipe, path: Path) -> None:
    """What one would write without this package: the same maps, through HDF5's own filters."""
    with h5py.File(path, "w") as file:
        for split, spec in recipe.splits.items():
            for name, values in generate(recipe, split, np.arange(spec.maps)).items():
                chunk = (1, *values.shape[1:]) if values.ndim > 2 else values.shape
                file.create_dataset(
                    f"{split}/{name}", data=values, chunks=chunk,
                    compression="gzip", shuffle=True, fletcher32=True,
                )  # fmt: skip


def read_maps(maps: TerrainMaps, order: np.ndarray) -> None:
    for index in order:
        maps[int(index)]


def read_plainly(path: Path, fields: tuple[str, ...], order: np.ndarray) -> None:
    """Opens the file for each map, as is safe under workers without further care."""
    for index in order:
        with h5py.File(path) as file:
            for name in fields:
                file["train"][name][index]


def make_shards(path: Path) -> None:
    """20 000 maps of 32 × 32 cells in 2 000 files."""
    paper = load_recipe("paper-v1")
    splits = {"train": Split(scenario="std", maps=SHARDS * MAPS_A_SHARD)}
    small = {"height": 32, "width": 32, "start_m": (4.0, 4.0), "goal_m": (12.0, 12.0)}
    recipe = replace(
        paper, id="shards", class_periods_m=(6.0, 3.0, 1.5), splits=splits,
        scenarios={"std": paper.scenarios["std"]}, **small,
    )  # fmt: skip
    for _ in create(recipe, path, jobs=2, shard_cells=MAPS_A_SHARD * 32 * 32):
        pass


def read_shards() -> None:
    """Times an epoch in windows of shards beside one in any order, and beside a file opened for every map."""
    import torch

    from benchnav.models.training.data import MapDataset
    from benchnav.models.training.map_order import MapSampler

    torch.set_num_threads(1)
    fields, batch = ("rgb", "class_id"), 16
    table = Table(
        "work", "maps/s, median (range)", "ratio", title=f"{SHARDS} shards of {MAPS_A_SHARD} maps of 32 × 32"
    )
    with tempfile.TemporaryDirectory() as folder:
        make_shards(Path(folder) / "shards")
        pieces = TerrainDataset(Path(folder) / "shards").pieces["train"]
        some = np.random.default_rng(0).integers(SHARDS * MAPS_A_SHARD, size=READS)

        def plainly() -> None:
            for index in some.tolist():
                with h5py.File(pieces[index // MAPS_A_SHARD].path) as file:
                    for name in fields:
                        file["train"][name][index % MAPS_A_SHARD]

        base, text = per_second(READS, plainly, 3, time.process_time)
        table.add_row("h5py, any order, file opened each time", text, "1")
        orders = {"any order": (), "windows of shards": tuple(piece.maps for piece in pieces)}
        for order, shards in orders.items():
            maps = MapDataset(Path(folder) / "shards", "train", fields)

            def epoch(maps: MapDataset = maps, shards: tuple[int, ...] = shards) -> None:
                symmetries = tuple(range(8))
                for key in MapSampler(len(maps), batch, symmetries=symmetries, shuffle=True, shards=shards):
                    maps[key]

            rate, text = per_second(len(maps), epoch, 3, time.process_time)
            table.add_row(f"batches of training, {order}", text, f"{rate / base:.1f}")
    Console().print(table)


def main() -> None:
    if sys.argv[1:] == ["shards"]:
        read_shards()
        return
    recipe = load_recipe("paper-v1")
    total = sum(split.maps for split in recipe.splits.values())
    table = Table("work", "maps/s, median (range)", "ratio", title=f"paper-v1, {total} maps of 64 × 64")
    with tempfile.TemporaryDirectory() as folder:
        path, plain = Path(folder) / "made.h5", Path(folder) / "plain.h5"
        base, text = per_second(total, lambda: write_plainly(recipe, plain), 3)
        table.add_row("generate, h5py's own filters, one process", text, "1")
        for jobs in (1, 2):
            rate, text = per_second(total, lambda jobs=jobs: make(recipe, path, jobs))  # type: ignore[misc]
            table.add_row(f"create, {jobs} worker(s), to closed file", text, f"{rate / base:.1f}")
        command = [str(Path(sys.executable).with_name("benchnav-datagen")), "create", "paper-v1"]
        command += ["--jobs", "2", "--overwrite", "--out", str(path)]
        rate, text = per_second(total, lambda: subprocess.run(command, check=True, capture_output=True), 3)
        table.add_row("the whole command, 2 workers", text, f"{rate / base:.1f}")
        order = np.random.default_rng(0).integers(1000, size=READS)
        for fields in (("rgb", "class_id"), schema.MAP_FIELDS):
            base_read, text = per_second(READS, lambda f=fields: read_plainly(path, f, order), 3)  # type: ignore[misc]
            table.add_row(f"read {len(fields)} fields, h5py, file opened each time", text, "1")
            for in_memory in (False, True):
                maps = TerrainMaps(path, "train", fields, in_memory=in_memory)
                rate, text = per_second(READS, lambda m=maps: read_maps(m, order))  # type: ignore[misc]
                where = "from memory" if in_memory else "from file"
                table.add_row(
                    f"read {len(fields)} fields, TerrainMaps {where}", text, f"{rate / base_read:.1f}"
                )
    Console().print(table)
    # The kernel counts kilobytes on Linux and bytes on macOS.
    unit = 1e6 if sys.platform == "darwin" else 1e3
    for who, name in ((resource.RUSAGE_SELF, "this process"), (resource.RUSAGE_CHILDREN, "a worker")):
        print(f"most memory of {name}: {resource.getrusage(who).ru_maxrss / unit:,.0f} MB")


if __name__ == "__main__":
    main()
