"""Running units on a Dask cluster, through joblib.

Workers write nothing that lasts: the files that a unit makes come back as bytes, and the command that asked for
them writes them. So workers share no disk with it, and a unit that was begun twice, since a worker died, is
there once. Before each unit its worker compares what rows depend on with what the run was begun with.
"""

import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import chdir, contextmanager, nullcontext
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from benchnav.core import workers
from benchnav.core.device import gpu_name
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.store import replacing
from benchnav.core.workers import run_calls
from benchnav.eval.experiment.unit import Extent, Unit
from benchnav.eval.folder import provenance

RunUnit = Callable[[Unit, Path, str, float, str], None]


@contextmanager
def connected(scheduler: str, planner_limit_s: float, device: str) -> Iterator[Any]:
    """A client of a cluster whose workers are fit for a run of this code.

    Args:
        scheduler: address, such as tcp://127.0.0.1:8786.
        planner_limit_s: time limit of each call of a planner; 0 for none.
        device: where all is to be computed, "cpu" or "cuda".

    Raises:
        ConfigError: the scheduler cannot be reached, has no worker, or has one that is not fit.
    """
    with workers.connected(scheduler) as client:
        own = {
            "code": provenance.describe_code(),
            "datasets": {},
            "parts": {},
            "planner_limit_s": planner_limit_s,
            "device": device,
            "gpu": gpu_name(device),
        }
        for address, state in client.run(describe_worker, on_error="return").items():
            check_worker(address, state, own)
        yield client


def run_on_cluster(
    client: Any, missing: Sequence[Unit], folder: Path, about: Mapping[str, Any], run_unit: RunUnit
) -> Iterator[None]:
    """Runs units on a cluster, yielding as each is in the run folder.

    Args:
        client: from `connected`.
        missing: what is run.
        folder: the run folder.
        about: its `run.json`.
        run_unit: runs a unit into a folder, given the run's id, the time limit of planners and the device.

    Raises:
        ConfigError: a worker is not fit for the run.
        BenchnavError: the cluster was lost, or a unit ended one worker after another.
    """
    if not missing:
        return
    given = about["run_id"]
    calls = [partial(_make, run_unit, Path.cwd(), unit, given, _subset(about, unit)) for unit in missing]
    for unit, files in run_calls(calls, scheduler=client.scheduler.address):
        _store(folder, unit, files)
        yield


def describe_worker(dask_worker: Any) -> dict[str, Any]:
    """What is asked of the process that a worker is; Dask gives the worker to a parameter of this name."""
    return {
        "code": _code(),
        "threads": dask_worker.state.nthreads,
        "starts_processes": not multiprocessing.current_process().daemon,
        "gpu": gpu_name("cuda") if torch.cuda.is_available() else None,
    }


def check_worker(address: str, state: Mapping[str, Any] | BaseException, about: Mapping[str, Any]) -> None:
    """Refuses a worker whose rows would not be those of the command's own process.

    Args:
        address: the worker's.
        state: from `describe_worker`, perhaps with `datasets` and `parts`; or what was raised there.
        about: the `run.json` of the run.

    Raises:
        ConfigError: the worker is not fit; the message names it and says why.
    """
    if isinstance(state, BaseException):
        raise ConfigError(
            f"Expected workers that have benchnav installed, got {address}, where this was raised: "
            f"{type(state).__name__}: {state}"
        )
    if state["threads"] != 1:
        raise ConfigError(
            f"Expected workers of one thread, got {address} with {state['threads']}. Start them with "
            "`dask worker ADDRESS --nworkers N --nthreads 1`."
        )
    if about["planner_limit_s"] and not state["starts_processes"]:
        raise ConfigError(
            f"Expected workers that may start processes, which `planner_limit_s` needs, got {address}. Start them "
            "with `dask worker … --no-nanny`, or with DASK_DISTRIBUTED__WORKER__DAEMON=False."
        )
    if about["device"] == "cuda" and not state["gpu"]:
        raise ConfigError(
            f"Expected workers with a GPU for `device` cuda, got {address} without. Pass --device cpu, or start "
            "workers on machines that have one."
        )
    given = {name: about[name] for name in ("planner_limit_s", "device")}
    now = {"datasets": {}, "parts": {}, **state, **given}
    now["gpu"] = state["gpu"] if about["device"] == "cuda" else None
    changed = provenance.differences(about, now)
    if changed:
        raise ConfigError(
            f"Expected workers of the same code and data as this command's, but {address} differs in "
            f"{'; '.join(changed)}. Start it anew from the same environment."
        )


@cache
def _code() -> dict[str, Any]:
    # Once a process: what it has imported stays what it was, whatever its files become.
    return provenance.describe_code()


def _make(
    run_unit: RunUnit, here: Path, unit: Unit, run_id: str, about: Mapping[str, Any]
) -> tuple[Unit, dict[str, bytes]]:
    """Runs a unit on a worker; gives what it wrote, by its place in a run folder."""
    from distributed import get_worker

    # Names of files begin where the command was given, if this machine has that place.
    with chdir(here) if here.is_dir() else nullcontext():
        extent = Extent(draws=((unit.seed, unit.realisation, unit.maps[-1] + 1),))
        conditions = {unit.condition.id: (unit.condition, extent)}
        worker = get_worker()
        try:
            state = {
                **describe_worker(worker),
                "datasets": provenance.describe_maps(conditions),
                "parts": provenance.describe_parts(conditions),
            }
        except BenchnavError as error:
            raise ConfigError(f"Worker {worker.address} lacks what the run needs: {error}") from error
        check_worker(worker.address, state, about)
        with TemporaryDirectory(dir=worker.local_directory) as scratch:
            run_unit(unit, Path(scratch), run_id, about["planner_limit_s"], about["device"])
            files = (path for path in Path(scratch).rglob("*") if path.is_file())
            return unit, {path.relative_to(scratch).as_posix(): path.read_bytes() for path in files}


def _subset(about: Mapping[str, Any], unit: Unit) -> dict[str, Any]:
    """What of `run.json` bears on a unit and is not told by the unit itself."""
    condition = unit.condition
    dataset = about["datasets"][condition.data]
    maps = {condition.split: dataset["maps"][condition.split][: unit.maps[-1] + 1]}
    return {
        "code": about["code"],
        "parts": about["parts"],
        "planner_limit_s": about["planner_limit_s"],
        "device": about["device"],
        "gpu": about["gpu"],
        "datasets": {condition.data: {"id": dataset["id"], "maps": maps, "about": dataset["about"]}},
    }


def _store(folder: Path, unit: Unit, files: Mapping[str, bytes]) -> None:
    """Writes what a unit made, its own file last, since that says that it is finished."""
    own = unit.path.as_posix()
    for name in [*(name for name in sorted(files) if name != own), own]:
        with replacing(folder / name) as partial:
            partial.write_bytes(files[name])
