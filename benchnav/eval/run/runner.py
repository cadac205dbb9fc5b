"""Running a suite into a run folder: check, cut into units, run what is missing, make the table of their rows.

A run folder is a store of finished units, each known by what made it (`Origin.key`). Running fills it: a run is resumed
or extended by giving the same command or another. A row does not depend on the number of workers, on the order of
units, or on interruptions.
"""

from collections.abc import Iterator
from contextlib import chdir
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from benchnav.core.device import find_device, gpu_name
from benchnav.core.errors import ConfigError
from benchnav.core.settings import plain
from benchnav.core.store import Shard, sole_writer
from benchnav.core.workers import connected, run_calls
from benchnav.eval.experiment.suite import RECORDS, Suite
from benchnav.eval.experiment.unit import Unit, in_table_order, units
from benchnav.eval.folder.folder import Finished, caveats, find_units, finish_run, write_errors
from benchnav.eval.folder.provenance import Origin, code_differences
from benchnav.eval.folder.steps import align_steps
from benchnav.eval.run.again import keep_ground
from benchnav.eval.run.begin import Work, begin, drop
from benchnav.eval.run.check import Say, check_suite
from benchnav.eval.run.cluster import run_on_worker, store_files
from benchnav.eval.run.latency import measure_latencies
from benchnav.eval.run.unit import Settings, run_unit

Task = tuple[Unit, Origin]


def run_suite(
    suite: Suite,
    folder: Path,
    jobs: int = 1,
    overwrite: bool = False,
    planner_limit_s: float = 0.0,
    say: Say = lambda line: None,
    shard: Shard | None = None,
    scheduler: str = "",
    device: str = "cpu",
    reuse_code: bool = False,
) -> Iterator[tuple[int, int]]:
    """Runs what is not finished of a suite, yielding (units done, units in all); to be iterated to the end.

    Args:
        suite: what is evaluated.
        folder: the run folder; it may hold a run, which is gone on with or extended.
        jobs: worker processes.
        overwrite: drop the run that is there.
        planner_limit_s: time limit of each call of a planner; 0 for none.
        say: is told what a user should know, a line at a time.
        shard: run this shard of the units alone; None for all.
        scheduler: address of a Dask cluster's scheduler, whose workers are used in place of `jobs`.
        device: where all is computed: "cpu", "cuda", or "auto" for CUDA where there is a GPU.
        reuse_code: take finished units that other code has made, and say so.

    Raises:
        ConfigError: the folder holds something else, or the suite cannot be run.
        DatasetError: the dataset lacks what the suite asks for.
        BenchnavError: the cluster cannot be reached, or was lost.
    """
    settings = Settings(planner_limit_s=planner_limit_s, device=find_device(device).type)
    with sole_writer(folder, str(folder)):
        checked = check_suite(suite, elsewhere=jobs > 1 or bool(scheduler) or planner_limit_s > 0)
        for line in caveats({"warnings": checked.warnings, "dropped": checked.dropped}):
            say(line)
        work = Work(
            suite=plain(suite),
            conditions=checked.conditions,
            dropped=checked.dropped,
            warnings=checked.warnings,
            hypotheses=checked.hypotheses,
            record=suite.record,
            settings=settings,
            shard=shard,
            reuse_code=reuse_code,
        )
        yield from run_work(work, folder, jobs, scheduler, overwrite, say)


def run_work(
    work: Work, folder: Path, jobs: int, scheduler: str, overwrite: bool, say: Say
) -> Iterator[tuple[int, int]]:
    """Runs what is not finished of some work in a folder that the caller holds; otherwise as `run_suite`."""
    if scheduler:
        with connected(scheduler):  # else nothing is dropped or written
            pass
    if work.settings.device == "cuda":
        say(f"computing on {gpu_name(work.settings.device)}")
    if overwrite:
        drop(folder)
    conditions = begin(work, folder, say)
    every = units(conditions, work.record)
    own = [unit for unit in every if work.shard is None or unit.shard(work.shard.of) == work.shard]
    origins = work.settings.origins()
    tasks = [(unit, origins.of(unit)) for unit in own]
    missing = _missing(tasks, folder, work.reuse_code, say)
    done = len(own) - len(missing)
    if own:
        yield done, len(own)
    else:
        say(f"none of the {len(every)} units is in shard {work.shard}")
    for _ in _run(missing, folder, work.settings, jobs, scheduler):
        done += 1
        yield done, len(own)
    measure_latencies(folder, {unit.condition.id for unit in own}, work.settings)
    finished, reused = _finished(
        [(unit, origins.of(unit)) for unit in in_table_order(own, conditions)], folder, work.reuse_code
    )
    if work.shard is not None:
        write_errors(folder, finished)
        return
    align_steps(folder, every)
    finish_run(folder, finished, reused)
    keep_ground(folder)


def _missing(tasks: list[Task], folder: Path, reuse_code: bool, say: Say) -> list[Task]:
    """What is to be run: units that are not finished, or not recorded as they are now to be."""
    missing, again, other = [], 0, dict[str, None]()
    unused = 0
    for unit, origin in tasks:
        known = find_units(folder, unit)
        counts = _counting(known, unit, origin, reuse_code)
        if counts is not None and counts.has(unit):
            continue
        if counts is not None:
            again += 1
            # With what it has kept, so that a run is never the poorer for being asked for more.
            record = max(unit.record, counts.about["record"], key=RECORDS.index)
            unit = replace(unit, record=record)
        elif known:
            unused += 1
            other |= dict.fromkeys(_differences(known[0], origin))
        missing.append((unit, origin))
    if done := len(tasks) - len(missing):
        say(f"{done} of {len(tasks)} units were there already")
    if again:
        say(f"run again for recordings or steps that were not asked for: {again} of {len(tasks)} units")
    if unused:
        say(
            f"finished by other code or maps ({'; '.join(other)}), so not used: {unused} of {len(tasks)} units; "
            "--reuse-code takes those of other code"
        )
    return missing


def _counting(known: list[Finished], unit: Unit, origin: Origin, reuse_code: bool) -> Finished | None:
    """The making of a unit that counts: that of the code and maps of now, else, if asked for, of other code."""
    own = [finished for finished in known if finished.about["key"] == origin.key(unit)]
    others = [finished for finished in known if finished.about["digests"] == list(origin.maps)]
    return next(iter([*own, *(others if reuse_code else [])]), None)


def _differences(finished: Finished, origin: Origin) -> list[str]:
    """What differs between the origin of a finished unit and another, in words."""
    maps = ["maps"] if finished.about["digests"] != list(origin.maps) else []
    return [*code_differences(finished.about["code"], origin.code), *maps]


def _run(missing: list[Task], folder: Path, settings: Settings, jobs: int, scheduler: str) -> Iterator[None]:
    """Runs units, here or on a cluster, yielding as each is in the run folder."""
    here, place = Path.cwd(), folder.resolve()
    if scheduler:
        calls: list[Any] = [partial(run_on_worker, here, *task, settings) for task in missing]
        for unit, files in run_calls(calls, scheduler=scheduler):
            store_files(folder, unit, files)
            yield
        return
    # Workers may be older than this call, so that they are told where names of files begin.
    yield from run_calls(
        [partial(_run_at, here, unit, place, origin, settings) for unit, origin in missing], jobs
    )


def _run_at(here: Path, unit: Unit, folder: Path, origin: Origin, settings: Settings) -> None:
    with chdir(here):
        run_unit(unit, folder, origin, settings)


def _finished(tasks: list[Task], folder: Path, reuse_code: bool) -> tuple[list[tuple[Unit, Finished]], str]:
    """The makings of all units that count, and a line on those of other code.

    Raises:
        ConfigError: one is not there any more.
    """
    found, differing = [], list[str]()
    reused = 0
    for unit, origin in tasks:
        counts = _counting(find_units(folder, unit), unit, origin, reuse_code)
        if counts is None:
            raise ConfigError(
                f"Expected unit {unit.name} of condition {unit.condition.id} in {folder}, which is not there any more. "
                "Give its `benchnav-eval run` command again."
            )
        found.append((unit, counts))
        if counts.about["key"] != origin.key(unit):
            reused += 1
            differing += _differences(counts, origin)
    if not reused:
        return found, ""
    names = "; ".join(dict.fromkeys(differing))
    return (
        found,
        f"{reused} of {len(tasks)} units are of other code ({names}); column `code` tells which rows",
    )
