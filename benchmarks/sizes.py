"""Do large things work in little memory? A map of 1024 × 1024 cells, 100 000 maps, a raster of 30 000 × 30 000 cells.

    python benchmarks/sizes.py                # 10 minutes and 10 GB of disk, in a temporary folder
    python benchmarks/sizes.py --only map

Every line is the command that it names, in processes of its own; the time is from start to end, the memory the most
that one process held. The two processes that make 100 000 maps are killed (SIGKILL) once each and started anew.
"""

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

MIB = 2**10
SIDE = 30_000
BAND = 500  # rows of the raster that are written at a time
LARGE_MAP = (
    "create paper-v1 id=wide height=1024 width=1024 splits.test/std.maps=1 --splits [test/std] --out wide.h5"
)
RUN = (
    "run --data wide.h5 --models [paper-v1] --risks [mean,cvar:0.9] --planners [astar_dwa] --scenarios [std]"
)
MANY = "create paper-v1 id=big splits.train.maps=100000 --out big --shard"
DEM = "import-dem dem.tif --out dem --stride 160 --splits train:0.8,valid:0.1,test/site:0.1"


class Memory:
    """The most memory that any process held which was waited for, KiB."""

    def __init__(self) -> None:
        self.most = 0

    def wait(self, process: subprocess.Popen[bytes]) -> int:
        """Waits for a process; gives its exit status."""
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        self.most = max(self.most, usage.ru_maxrss)
        return process.returncode


def start(folder: Path, words: str) -> subprocess.Popen[bytes]:
    """Starts a command, its words parted by spaces."""
    program, *rest = words.split()
    command = [Path(sys.executable).with_name(program), *rest]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def run(folder: Path, words: str) -> tuple[str, float, int]:
    """Runs a command to its end; gives it, the seconds and the memory."""
    begun, memory = time.perf_counter(), Memory()
    if memory.wait(start(folder, words)):
        sys.exit(f"failed: {words}")
    return words, time.perf_counter() - begun, memory.most


def many_maps(folder: Path) -> tuple[str, float, int]:
    """Makes 100 000 maps by two processes, each killed after 30 s of work."""
    begun, memory = time.perf_counter(), Memory()
    making = [start(folder, f"benchnav-datagen {MANY} {share}/2") for share in (1, 2)]
    for place in (0, 1):
        time.sleep(30)
        making[place].kill()
        memory.wait(making[place])
        making[place] = start(folder, f"benchnav-datagen {MANY} {place + 1}/2")
    ended = [memory.wait(process) for process in making]
    if any(ended):
        sys.exit("failed: making 100 000 maps")
    return (
        f"benchnav-datagen {MANY} 1/2, and 2/2, each killed once",
        time.perf_counter() - begun,
        memory.most,
    )


def write_raster(path: Path) -> None:
    """Hills of 5 to 400 m and rough ground, 0.5 m a cell, in UTM zone 33."""
    import rasterio
    from rasterio.transform import from_origin

    generator = np.random.default_rng(0)
    waves = [(generator.uniform(5, 400), *generator.uniform(0, 2 * np.pi, 2)) for _ in range(12)]
    x = np.arange(SIDE, dtype=np.float32) * 0.5
    profile = {
        "driver": "GTiff",
        "height": SIDE,
        "width": SIDE,
        "count": 1,
        "dtype": "float32",
        "crs": "EPSG:32633",
    }
    tiles = {"tiled": True, "compress": "deflate", "predictor": 3, "BIGTIFF": "YES"}
    place = from_origin(400_000, 5_300_000, 0.5, 0.5)
    with rasterio.open(path, "w", **profile, **tiles, transform=place) as raster:
        for first in range(0, SIDE, BAND):
            y = x[first : first + BAND, None]
            ground = 0.02 * generator.standard_normal((len(y), SIDE), dtype=np.float32)
            for length, phase, turn in waves:
                along = np.float32(np.cos(turn)) * x + np.float32(np.sin(turn)) * y
                ground += np.float32(0.02 * length) * np.sin(
                    along * np.float32(2 * np.pi / length) + np.float32(phase)
                )
            raster.write(ground, 1, window=((first, first + len(y)), (0, SIDE)))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=("map", "many", "raster"))
    given = parser.parse_args()
    lines = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if given.only in (None, "map"):
            lines += [
                run(folder, f"benchnav-datagen {LARGE_MAP}"),
                run(folder, "benchnav-train evaluate paper-v1 --data wide.h5"),
                run(folder, f"benchnav-eval {RUN} --maps 1 --out large"),
            ]
        if given.only in (None, "many"):
            lines += [many_maps(folder), run(folder, "benchnav-datagen validate big")]
        if given.only in (None, "raster"):
            # In a process of its own: what this one held would count for those that it starts.
            writer = multiprocessing.get_context("spawn").Process(
                target=write_raster, args=(folder / "dem.tif",)
            )
            writer.start()
            writer.join()
            lines += [run(folder, f"benchnav-datagen {DEM}"), run(folder, "benchnav-datagen validate dem")]
    table = Table(title="large things", title_justify="left")
    table.add_column("command")
    table.add_column("time s", justify="right")
    table.add_column("memory MiB", justify="right")
    for words, seconds, memory in lines:
        table.add_row(words, f"{seconds:.0f}", f"{memory / MIB:.0f}")
    Console(width=150).print(table, markup=False)


if __name__ == "__main__":
    main()
