"""Running a suite into a run folder: unit by unit, in parallel, to be resumed or extended at any moment.

A row does not depend on the number of workers, on the order of units, or on interruptions.
"""

import json
import os
import secrets
import shutil
import traceback
import warnings
from collections.abc import Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import chdir, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import torch

from benchnav.device import find_device, gpu_name
from benchnav.errors import BenchnavError, ConfigError
from benchnav.eval.folder import provenance
from benchnav.eval.folder.changes import changed_options
from benchnav.eval.folder.folder import (
    EPISODES,
    FORMAT,
    FORMAT_VERSION,
    RUN,
    about_unit,
    has_all,
    kept,
    merge_tables,
    open_run,
    write_errors,
    write_unit,
)
from benchnav.eval.folder.steps import align_steps, write_steps
from benchnav.eval.keep import Keep
from benchnav.eval.run.check import check_suite
from benchnav.eval.run.check_world import Say
from benchnav.eval.run.cluster import connected, run_on_cluster
from benchnav.eval.run.driven_ground import keep_ground
from benchnav.eval.run.episode import (
    PredictionError,
    build,
    one_thread,
    read_block,
    simulate,
    time_budgets,
)
from benchnav.eval.run.recorder import Recorder
from benchnav.eval.run.rows import episode_rows, error_rows, step_table
from benchnav.eval.suite import Suite
from benchnav.eval.trial import Trial, check_labels
from benchnav.eval.unit import Extent, Unit, in_table_order, units
from benchnav.files import sole_writer, write_text
from benchnav.planning.world.outcome import Outcome
from benchnav.share import Share
from benchnav.workers import end_with

Trials = dict[str, tuple[Trial, Extent]]


@dataclass(frozen=True, kw_only=True)
class Work:
    """What a command asks of a run.

    Args:
        suite: as it was written, for `run.json`.
        trials: by id, with how often each is to be run.
        keep: what is recorded of episodes, and of which the steps are stored.
        planner_limit_s: time limit of each call of a planner; 0 for none.
        shard: which share of the units is run; None for all.
        device: where all is computed, "cpu" or "cuda".
    """

    suite: Mapping[str, Any]
    trials: Trials
    keep: Keep
    planner_limit_s: float = 0.0
    shard: Share | None = None
    device: str = "cpu"


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Who runs the units.

    Args:
        jobs: worker processes on this machine.
        scheduler: address of a Dask cluster's scheduler, whose workers take their place; empty for none.
    """

    jobs: int = 1
    scheduler: str = ""

    @property
    def elsewhere(self) -> bool:
        """Whether units are run in other processes."""
        return self.jobs > 1 or bool(self.scheduler)


def run_suite(
    suite: Suite,
    folder: Path,
    jobs: int = 1,
    overwrite: bool = False,
    planner_limit_s: float = 0.0,
    say: Say = lambda line: None,
    shard: Share | None = None,
    scheduler: str = "",
    device: str = "cpu",
) -> Iterator[tuple[int, int]]:
    """Runs what is not finished of a suite, yielding (units done, units in all); to be iterated to the end.

    Args:
        suite: what is evaluated.
        folder: the run folder; it may hold a run, which is gone on with or extended.
        jobs: worker processes.
        overwrite: drop the run that is there.
        planner_limit_s: time limit of each call of a planner; 0 for none.
        say: is told what a user should know, a line at a time.
        shard: run this share of the units alone; None for all.
        scheduler: address of a Dask cluster's scheduler, whose workers are used in place of `jobs`.
        device: where all is computed: "cpu", "cuda", or "auto" for CUDA where there is a GPU.

    Raises:
        ConfigError: the folder holds something else or a run of other code, or the suite cannot be run.
        DatasetError: the dataset lacks what the suite asks for.
        BenchnavError: the cluster cannot be reached, or was lost.
    """
    workers, found = Workers(jobs=jobs, scheduler=scheduler), find_device(device)
    with sole_writer(folder, str(folder)):
        wanted = check_suite(suite, workers.elsewhere or planner_limit_s > 0, say)
        work = Work(
            suite=suite.to_dict(),
            trials=wanted,
            keep=suite.keep,
            planner_limit_s=planner_limit_s,
            shard=shard,
            device=found.type,
        )
        yield from run_work(work, folder, workers, overwrite, say)


def run_work(
    work: Work, folder: Path, workers: Workers, overwrite: bool, say: Say
) -> Iterator[tuple[int, int]]:
    """Runs what is not finished of some work in a folder that the caller holds; otherwise as `run_suite`."""
    reached: Any = nullcontext()
    if workers.scheduler:
        reached = connected(workers.scheduler, work.planner_limit_s, work.device)
    if work.device == "cuda":
        say(f"computing on {gpu_name(work.device)}")
    with reached as cluster:
        if overwrite:
            _drop(folder)
        about, trials = _begin(work, folder, say)
        every = units(trials, work.keep)
        own = [unit for unit in every if work.shard is None or unit.share(work.shard.of) == work.shard]
        known = [(unit, about_unit(folder, unit, about["run_id"])) for unit in own]
        # With what it has kept, so that a run is never the poorer for being asked for more.
        missing = [
            replace(unit, keep=unit.keep.joined(kept(folder, unit, about["run_id"])))
            for unit, found in known
            if not has_all(found, unit)
        ]
        done = len(own) - len(missing)
        if done:
            say(f"{done} of {len(own)} units were there already")
        if again := sum(found is not None and not has_all(found, unit) for unit, found in known):
            say(f"{again} finished units are run again for recordings or steps that they were not asked for")
        if own:
            yield done, len(own)
        else:
            say(f"none of the {len(every)} units is in shard {work.shard}")
        if cluster is None:
            finished = _run_here(missing, folder, about, workers.jobs)
        else:
            finished = run_on_cluster(cluster, missing, folder, about, run_unit)
        for _ in finished:
            done += 1
            yield done, len(own)
    _check_unchanged(folder)
    if work.shard is None:
        align_steps(folder, every)
        merge_tables(folder, in_table_order(every, trials), about["run_id"])
        keep_ground(folder)
    else:
        write_errors(folder, in_table_order(own, trials), about["run_id"])


def run_unit(
    unit: Unit, folder: Path, run_id: str, planner_limit_s: float = 0.0, device: str | torch.device = "cpu"
) -> None:
    """Runs one unit on one thread and writes its file, and before it its recordings and steps.

    Args:
        unit: what is run.
        folder: the run folder.
        run_id: of the run that it belongs to.
        planner_limit_s: time limit of each call of the planner; 0 for none.
        device: where all is computed.
    """
    place = torch.device(device)
    about: dict[str, Any] = {"run_id": run_id, "traceback": "", "errors": []}
    with one_thread():
        try:
            problem, simulation = build(unit, run_id, place)
        except PredictionError as error:
            about |= {"traceback": traceback.format_exc(), "errors": [str(error)]}
            rows = error_rows(unit, time_budgets(unit, run_id), str(error))
            write_unit(folder, unit, rows, about)
            return
        watched = unit.keep.watched(len(unit.instances))
        recorder = Recorder(unit, problem, simulation, read_block(unit, run_id, place).terrain, watched)
        watch = recorder.watch if watched else None
        episodes, compiled = simulate(unit, problem, simulation, watch, recorder.every, planner_limit_s)
    succeeded = (episodes.outcome == Outcome.SUCCESS).tolist()
    for member in unit.keep.recorded(succeeded):
        recorder.write(episodes, member, folder)
    if stored := unit.keep.with_steps(succeeded):
        write_steps(folder, unit, step_table(unit, problem, episodes, stored))
    about |= {"traceback": episodes.traceback, "errors": sorted({e for e in episodes.errors if e})}
    reference = read_block(unit, run_id, place).places.reference_time_s.cpu().numpy()
    redrawn = (simulation.attempts - 1).tolist()
    rows = episode_rows(unit, problem, episodes, reference, redrawn, compiled)
    write_unit(folder, unit, rows, about)


def _run_here(missing: list[Unit], folder: Path, about: Mapping[str, Any], jobs: int) -> Iterator[None]:
    # Workers may be older than this call, so that they are told where names of files begin.
    here, target = Path.cwd(), folder.resolve()
    given = about["run_id"], about["planner_limit_s"], about["device"]
    run = partial(_run_in_worker, os.getpid()) if jobs > 1 else _run_at
    calls = (joblib.delayed(run)(here, unit, target, *given) for unit in missing)
    finished = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")(calls)
    for _ in missing:
        with warnings.catch_warnings():
            # A worker whose memory has grown is replaced; that is no concern of a user's.
            warnings.filterwarnings("ignore", message="A worker stopped while some jobs were given")
            try:
                next(finished)
            except BrokenProcessPool as error:
                raise BenchnavError(
                    "A worker was killed, perhaps for want of memory. What was finished is kept: give the same "
                    "command again, if need be with fewer `jobs`."
                ) from error
        yield


def _run_in_worker(parent: int, *given: Any) -> None:
    if os.getpid() != parent:  # joblib may make the calls here, where it can start no processes
        end_with(parent)
    _run_at(*given)


def _run_at(here: Path, unit: Unit, folder: Path, run_id: str, planner_limit_s: float, device: str) -> None:
    with chdir(here):
        run_unit(unit, folder, run_id, planner_limit_s, device)


def _drop(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        open_run(folder)  # Only what is a run folder may be dropped.
        dropped = folder.with_name(f".{folder.name}.{os.getpid()}.dropped")
        os.replace(folder, dropped)
        shutil.rmtree(dropped)


def _begin(work: Work, folder: Path, say: Say) -> tuple[dict[str, Any], Trials]:
    """Writes `run.json`, or extends the one that is there; gives what it holds and all trials."""
    if not (folder / RUN).exists():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ConfigError(
                f"Expected `out` to be a new folder or a run folder, but {folder} holds something else."
            )
        about = _about(secrets.token_hex(8), work, work.trials, [])
        write_text(folder / RUN, json.dumps(about, indent=1))
        return about, work.trials
    earlier = open_run(folder)
    if earlier.version < FORMAT_VERSION:
        raise ConfigError(
            f"Expected `out` to be new or a run of format version {FORMAT_VERSION}, but {folder} is of version "
            f"{earlier.version}, which can be reported and not gone on with. Choose another `out`."
        )
    if earlier.shard != work.shard:
        raise ConfigError(
            f"Expected `out` to be new or to hold {_share(work.shard)}, but {folder} holds "
            f"{_share(earlier.shard)}. Choose another `out`."
        )
    trials = _joined(earlier.trials, work.trials)
    check_labels(trial for trial, _ in trials.values())
    now = _about(earlier.about["run_id"], work, trials, earlier.about["commands"])
    changed = provenance.differences(earlier.about, now)
    if changed:
        raise ConfigError(
            f"Expected `out` to be new or a run of the same code and data, but since {folder} was begun these "
            f"changed: {'; '.join(changed)}. Choose another `out`{_or_its_device(earlier.about, now)}, or pass "
            "--overwrite."
        )
    if trials != earlier.trials:
        new = len(trials) - len(earlier.trials)
        more = {0: "by more episodes", 1: "by 1 new trial"}.get(new, f"by {new} new trials")
        say(f"{folder} is extended {more}")
        (folder / EPISODES).unlink(missing_ok=True)  # until all that is asked for is there
        write_text(folder / RUN, json.dumps(now, indent=1))
    return now, trials


def _or_its_device(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    device = earlier.get("device", "cpu")
    return "" if device == now["device"] else f", pass --device {device}"


def _share(shard: Share | None) -> str:
    return "a whole run" if shard is None else f"shard {shard} of one"


def _joined(earlier: Trials, wanted: Trials) -> Trials:
    """Every trial of both, each at the greater extent."""
    joined = dict(earlier)
    for trial_id, (trial, extent) in wanted.items():
        known = joined.get(trial_id)
        joined[trial_id] = (trial, known[1].union(extent) if known else extent)
    return joined


def _check_unchanged(folder: Path) -> None:
    """Refuses to make one table of rows of which some may be of other code than others."""
    run = open_run(folder)
    about = run.about
    now = {**about, **provenance.describe(run.trials)}
    changed = provenance.differences(about, json.loads(json.dumps(now)))
    if changed:
        raise ConfigError(
            f"While {folder} was running these changed: {'; '.join(changed)}. Its rows may be of either. "
            "Run it again with --overwrite."
        )


def _about(run_id: str, work: Work, trials: Trials, commands: list[str]) -> dict[str, Any]:
    entries = {
        trial_id: {"value": trial.value, "labels": trial.labels, **_notes(trial), **extent.to_dict()}
        for trial_id, (trial, extent) in trials.items()
    }
    about = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "run_id": run_id,
        **({"shard": work.shard.to_dict()} if work.shard else {}),
        "suite": dict(work.suite),
        "trials": entries,
        "planner_limit_s": work.planner_limit_s,
        "device": work.device,
        "gpu": gpu_name(work.device),
        **provenance.describe(trials),
        "machine": provenance.describe_machine(),
        "commands": provenance.command_lines(commands),
    }
    return json.loads(json.dumps(about))


def _notes(trial: Trial) -> dict[str, Any]:
    """What tables say of a trial's planner."""
    planner = trial.make_planner()
    remarks = getattr(planner, "remarks", None)
    return {
        "follows": str(getattr(planner, "follows", "J")),
        "remarks": list(remarks(trial.make_task())) if remarks else [],
        "changed": changed_options(trial.planner),
    }
