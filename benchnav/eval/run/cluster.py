"""Units on the workers of a Dask cluster.

Workers write nothing that lasts: the files that a unit makes come back as bytes, and
the command that asked for them writes them. So workers share no disk with it, and a
unit that was begun twice, since a worker died, is there once.
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
    here: Path, unit: Unit, origin: Origin, settings: Settings
) -> tuple[Unit, dict[str, bytes]]:
    """Runs a unit on a worker of a cluster; gives what it wrote, by its place in a run
    folder.

    Args:
        here: where names of files begin, if the worker's machine has that place.
        unit: what is run.
        origin: of the unit as the run was begun.
        settings: how it is run.

    Raises:
        ConfigError: the worker is not fit for the run, or its code or maps are others;
            the message names it.
    """
    from distributed import get_worker

    worker = get_worker()
    check_worker(worker, settings)
    with (
        chdir(here) if here.is_dir() else nullcontext(),
        TemporaryDirectory(dir=worker.local_directory) as scratch,
    ):
        try:
            run_unit(unit, Path(scratch), origin, settings)
        except BenchnavError as error:
            raise type(error)(f"Worker {worker.address}: {error}") from error
        files = (path for path in Path(scratch).rglob("*") if path.is_file())
        return unit, {
            path.relative_to(scratch).as_posix(): path.read_bytes() for path in files
        }


def check_worker(worker: Any, settings: Settings) -> None:
    """Refuses a worker whose rows would not be those of the command's own process.

    Args:
        worker: Dask's.
        settings: how units are run.

    Raises:
        ConfigError: the worker is not fit.
    """
    threads = worker.state.nthreads
    if threads != 1:
        raise ConfigError(
            f"Expected workers of one thread, got {worker.address} with {threads}. "
            "Start them with "
            "`dask worker ADDRESS --nworkers N --nthreads 1`."
        )
    if settings.planner_limit_s and multiprocessing.current_process().daemon:
        raise ConfigError(
            "Expected workers that may start processes, which `planner_limit_s` "
            f"needs, got {worker.address}. Start "
            "them with `dask worker … --no-nanny`, or with "
            "DASK_DISTRIBUTED__WORKER__DAEMON=False."
        )
    if settings.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"Expected workers with a GPU for `device` cuda, got {worker.address} "
            "without. Pass --device cpu, or "
            "start workers on machines that have one."
        )


def store_files(folder: Path, unit: Unit, files: Mapping[str, bytes]) -> None:
    """Writes what a unit made into a run folder, its rows last, since they say that it
    is finished.
    """
    clear_unit(folder, unit)
    for name in sorted(files, key=lambda name: name.startswith("units/")):
        with replacing(folder / name) as partial:
            partial.write_bytes(files[name])
