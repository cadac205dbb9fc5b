"""Units on the workers of a Dask cluster.

A worker returns a unit's files as bytes, and the command's process writes these files.
Workers therefore need no common disk, and a unit that is run twice because a worker
died is stored once.
"""

import multiprocessing
from collections.abc import Mapping
from contextlib import chdir, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.store import replacing
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.folder.provenance import Origin
from benchnav.eval.folder.run_folder import clear_unit
from benchnav.eval.run.unit import Settings, run_unit


def run_on_worker(
    working_folder: Path, unit: Unit, origin: Origin, settings: Settings
) -> tuple[Unit, dict[str, bytes]]:
    """Run a unit on a worker, and return the unit's files by path in a run folder.

    Args:
        working_folder: folder at which relative paths start, if it exists on the
            worker.
        unit: unit to run.
        origin: origin of the unit when the run was begun.
        settings: settings of the run.

    Raises:
        ConfigError: If `check_worker` rejects the worker, or the worker has other code
            or maps; the message names the worker.
    """
    from distributed import get_worker

    worker = get_worker()
    check_worker(worker, settings)
    has_folder = working_folder.is_dir()
    with (
        chdir(working_folder) if has_folder else nullcontext(),
        TemporaryDirectory(dir=worker.local_directory) as scratch,
    ):
        try:
            run_unit(unit, Path(scratch), origin, settings)
        except BenchnavError as error:
            raise type(error)(f"Worker {worker.address}: {error}") from error
        files = {}
        for path in Path(scratch).rglob("*"):
            if path.is_file():
                name = path.relative_to(scratch).as_posix()
                files[name] = path.read_bytes()
        return unit, files


def check_worker(worker: Any, settings: Settings) -> None:
    """Reject a worker whose rows would differ from rows of the command's process.

    Args:
        worker: Dask worker.
        settings: settings of the run.

    Raises:
        ConfigError: If the worker has several threads, or lacks a GPU or the
            permission to start processes, although the settings need it.
    """
    threads = worker.state.nthreads
    if threads != 1:
        raise ConfigError(
            f"Expected workers with one thread, got {worker.address} with {threads}. "
            "Start workers by `dask worker ADDRESS --nworkers N --nthreads 1`."
        )
    if settings.planner_limit_s and multiprocessing.current_process().daemon:
        raise ConfigError(
            "Expected workers that may start processes for `planner_limit_s`, got "
            f"{worker.address}, which may not. Start workers by `dask worker … "
            "--no-nanny`, or set DASK_DISTRIBUTED__WORKER__DAEMON=False."
        )
    if settings.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"Expected workers with a GPU for `device` cuda, got {worker.address} "
            "without a GPU. Pass --device cpu, or start workers on machines with a GPU."
        )


def store_files(folder: Path, unit: Unit, files: Mapping[str, bytes]) -> None:
    """Write a unit's files into a run folder; the rows, last, mark it finished."""
    clear_unit(folder, unit)
    for name in sorted(files, key=lambda name: name.startswith("units/")):
        with replacing(folder / name) as partial:
            partial.write_bytes(files[name])
