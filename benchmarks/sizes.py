"""Time and memory of commands on large inputs.

    python -m benchmarks.sizes                # 10 minutes and 10 GB of disk, in a temporary folder

The inputs are a map of 1024 × 1024 cells, 100 000 maps, and a raster of 30 000 × 30 000
cells. Every row is for the command that it names, in new processes. The time is from
start to end, the memory the maximum of one process. The two processes that create
100 000 maps are killed (SIGKILL) once each and restarted.
"""

import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import show

MIB = 2**10
SIDE, BAND = 30_000, 500  # side of the raster in cells, and rows per write
MANY = (
    "benchnav-datagen create paper-v1 id=big splits.train.maps=100000 --out big --shard"
)
COMMANDS = (
    "benchnav-datagen create paper-v1 id=wide height=1024 width=1024 "
    "splits.test/std.maps=1 --splits [test/std] "
    "--out wide.h5",
    "benchnav-train evaluate paper-v1 --data wide.h5",
    "benchnav-eval run --data wide.h5 --models [paper-v1] --risks [mean,cvar:0.9] "
    "--planners [astar_dwa] "
    "--scenarios [std] --maps 1 --out large",
    MANY,
    "benchnav-datagen validate big",
    "benchnav-datagen import-dem dem.tif --out dem --stride 160 --splits "
    "train:0.8,valid:0.1,test/site:0.1",
    "benchnav-datagen validate dem",
)


class Processes:
    """Processes that run in a folder, with the peak memory of a single one in KiB."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.memory = 0

    def start(self, words: str) -> subprocess.Popen[bytes]:
        """Start a command whose words are separated by spaces."""
        program, *rest = words.split()
        command = [Path(sys.executable).with_name(program), *rest]
        return subprocess.Popen(
            command,
            cwd=self.folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def wait(self, process: subprocess.Popen[bytes]) -> int:
        """Wait for a process; return its exit status."""
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        self.memory = max(self.memory, usage.ru_maxrss)
        return process.returncode

    def make_many(self) -> bool:
        """Create 100 000 maps with two processes, each killed once after 30 s.

        Returns:
            Whether one of them failed after its restart.
        """
        shards = [f"{MANY} {index}/2" for index in (1, 2)]
        processes = [self.start(words) for words in shards]
        for index, words in enumerate(shards):
            time.sleep(30)
            processes[index].kill()
            self.wait(processes[index])
            processes[index] = self.start(words)
        statuses = [self.wait(process) for process in processes]
        return any(statuses)


def run(folder: Path, words: str) -> dict[str, Any]:
    """Run a command to its end; return its row of the table."""
    begun, processes = time.perf_counter(), Processes(folder)
    if (
        processes.make_many()
        if words == MANY
        else processes.wait(processes.start(words))
    ):
        sys.exit(f"failed: {words}")
    return {
        "command": words,
        "s": time.perf_counter() - begun,
        "MiB": processes.memory / MIB,
    }


def write_raster(path: Path) -> None:
    """Write rough terrain with hills of 5 to 400 m, in cells of 0.5 m, UTM zone 33."""
    import rasterio
    from rasterio.transform import from_origin

    generator = np.random.default_rng(0)
    waves = [
        (generator.uniform(5, 400), *generator.uniform(0, 2 * np.pi, 2))
        for _ in range(12)
    ]
    x = np.arange(SIDE, dtype=np.float32) * 0.5
    profile = {
        "driver": "GTiff",
        "height": SIDE,
        "width": SIDE,
        "count": 1,
        "dtype": "float32",
        "crs": "EPSG:32633",
        "tiled": True,
        "compress": "deflate",
        "predictor": 3,
        "BIGTIFF": "YES",
        "transform": from_origin(400_000, 5_300_000, 0.5, 0.5),
    }
    with rasterio.open(path, "w", **profile) as raster:
        for first in range(0, SIDE, BAND):
            y = x[first : first + BAND, None]
            ground = 0.02 * generator.standard_normal((len(y), SIDE), dtype=np.float32)
            for length, phase, turn in waves:
                along = np.float32(np.cos(turn)) * x + np.float32(np.sin(turn)) * y
                wave = np.sin(
                    along * np.float32(2 * np.pi / length) + np.float32(phase)
                )
                ground += np.float32(0.02 * length) * wave
            raster.write(ground, 1, window=((first, first + len(y)), (0, SIDE)))


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # Write in another process: the peak memory of this one would be counted for
        # the processes that it starts.
        writer = multiprocessing.get_context("spawn").Process(
            target=write_raster, args=(folder / "dem.tif",)
        )
        writer.start()
        writer.join()
        show([run(folder, words) for words in COMMANDS])


if __name__ == "__main__":
    main()
