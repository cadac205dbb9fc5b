"""Running a suite into a run folder: check, cut into units, run what is missing, make
the table of their rows.

A run folder is a store of finished units, each known by what made it (`Origin.key`).
Running fills it: a run is resumed or extended by giving the same command or another. A
row does not depend on the number of workers, on the order of units, or on
interruptions.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import chdir
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from benchnav.core.device import gpu_name
from benchnav.core.errors import ConfigError
from benchnav.core.progress import Progress
from benchnav.core.store import Shard, sole_writer
from benchnav.core.touched import changes_since, unlike
from benchnav.core.workers import connected, run_calls
from benchnav.eval.experiment.suite import RECORDS, Record, Suite
from benchnav.eval.experiment.unit import (
    Conditions,
    Unit,
    in_table_order,
    unit_names,
    units,
)
from benchnav.eval.folder.checksums import note_checksums
from benchnav.eval.folder.provenance import (
    TOUCHED,
    Origin,
    Origins,
    code_differences,
    lacks_metrics,
)
from benchnav.eval.folder.run_folder import (
    EPISODES,
    ERRORS,
    Finished,
    find_units,
    finish_run,
    unit_path,
    write_errors,
)
from benchnav.eval.folder.steps import align_steps
from benchnav.eval.run.begin import Work, begin, drop
from benchnav.eval.run.check import Say, check_suite
from benchnav.eval.run.cluster import run_on_worker, store_files
from benchnav.eval.run.latency import measure_latencies
from benchnav.eval.run.recordings import keep_ground
from benchnav.eval.run.unit import Settings, run_unit


def run_suite(
    suite: Suite,
    folder: Path,
    jobs: int | str = 1,
    overwrite: bool = False,
    settings: Settings = Settings(),  # noqa: B008
    say: Say = lambda line: None,
    shard: Shard | None = None,
    reuse_code: bool = False,
) -> Iterator[Progress]:
    """Run the units of a suite that are not finished, and yield the progress in units;
    iterate to the end.

    Units of a run that the suite does not name stay as they are. While any of them is
    not finished, the run has no table, which `say` receives as a line.

    Args:
        suite: what is evaluated.
        folder: the run folder; it may hold a run, which is resumed or extended.
        jobs: number of worker processes, or the address of a Dask cluster's scheduler,
            whose workers are used.
        overwrite: whether to drop the run that exists.
        settings: how units are run: device, and time limit of planners.
        say: receives what a user should know, a line at a time.
        shard: the shard of the units that is run; None for all.
        reuse_code: whether to take finished units of other code, and say so.

    Raises:
        ConfigError: If the folder holds something else, or the suite cannot be run.
        DatasetError: If the dataset lacks what the suite asks for.
        BenchnavError: If the cluster cannot be reached, or is lost.
    """
    with sole_writer(folder, str(folder)):
        checked = check_suite(
            suite, elsewhere=jobs != 1 or settings.planner_limit_s > 0
        )
        for line in checked.caveats:
            say(line)
        work = Work(
            **vars(checked),
            suite=suite.plain,
            record=suite.record,
            settings=settings,
            shard=shard,
            reuse_code=reuse_code,
        )
        yield from run_work(work, folder, jobs, overwrite, say)


def run_work(
    work: Work, folder: Path, jobs: int | str, overwrite: bool, say: Say
) -> Iterator[Progress]:
    """Run the units of some work that are not finished in a folder that the caller has
    locked; see `run_suite`.
    """
    jobs, scheduler = (1, jobs) if isinstance(jobs, str) else (jobs, "")
    if scheduler:
        with connected(scheduler):  # else nothing is dropped or written
            pass
    if work.settings.device == "cuda":
        say(f"running on {gpu_name(work.settings.device)}")
    if overwrite:
        drop(folder)
    asked, conditions, metrics = begin(work, folder, say)
    every = units(conditions, work.record, metrics)
    own = [
        unit
        for unit in every
        if work.shard is None or unit.shard(work.shard.of) == work.shard
    ]
    named, others = _parted(own, asked)
    origins = work.settings.origins()
    missing = _missing(
        named, origins, folder, work.reuse_code, say, is_here=not scheduler
    )
    if not own:
        say(f"shard {work.shard} holds none of the {len(every)} units")
    # Workers may be older than this call, so that they are told where names of files
    # begin.
    run = (
        partial(run_on_worker, Path.cwd())
        if scheduler
        else partial(_run_in, Path.cwd(), folder.resolve())
    )
    calls: list[Any] = [
        partial(run, unit, origin, work.settings) for unit, origin in missing
    ]
    steps = _Steps(
        named, [unit for unit, _ in missing], in_turn=jobs == 1 and not scheduler
    )
    if named:
        yield steps.progress()
    for unit, files in run_calls(calls, jobs, scheduler):
        if scheduler:
            store_files(folder, unit, files)
        yield steps.progress(unit)
    if missing:
        say("measuring the planning time of one robot alone")
    measure_latencies(folder, {unit.condition.id for unit in named}, work.settings)
    finished, reused = _finished(
        in_table_order(named, conditions), origins, folder, work.reuse_code
    )
    if others:
        lacking = [
            unit
            for unit in others
            if _counted(unit, origins, folder, work.reuse_code) is None
        ]
        if lacking:
            write_errors(folder, finished)
            note_checksums(folder, [folder / ERRORS])
            if missing:  # a table that is there is of other makings of what was run
                (folder / EPISODES).unlink(missing_ok=True)
            say(_unfinished(folder, lacking, len(conditions)))
            return
        finished, reused = _finished(
            in_table_order(own, conditions), origins, folder, work.reuse_code
        )
    if not work.reuse_code:
        _check_steady([one for _, one in finished], is_here=not scheduler)
    if work.shard is not None:
        write_errors(folder, finished)
        note_checksums(folder, [folder / ERRORS])
        return
    align_steps(folder, every)
    finish_run(folder, finished, reused)
    note_checksums(folder, [folder / ERRORS])
    keep_ground(folder)


def _parted(
    own: Sequence[Unit], conditions: Conditions
) -> tuple[list[Unit], list[Unit]]:
    """The units of a run that hold anything of what a command names, and the others; a
    block of maps stays whole.
    """
    blocks = {
        (u.condition.id, u.seed, u.realisation, u.block) for u in units(conditions)
    }
    parted: tuple[list[Unit], list[Unit]] = [], []
    for u in own:
        parted[(u.condition.id, u.seed, u.realisation, u.block) not in blocks].append(u)
    return parted


def _unfinished(folder: Path, lacking: Sequence[Unit], conditions: int) -> str:
    ids = {unit.condition.id for unit in lacking}
    other = sum(bool(find_units(folder, unit)) for unit in lacking)
    why = f" ({other} of their units are of other code or maps)" if other else ""
    return (
        f"what this command names is finished; {len(ids)} of {conditions} conditions "
        f"of {folder} are not{why}, so that "
        "the run has no new table. Give the command that named them, or read what is "
        "there with `report --partial`"
    )


class _Steps:
    """Counts units as they are finished, and names them by what tells them apart."""

    def __init__(
        self, named: Sequence[Unit], missing: Sequence[Unit], in_turn: bool
    ) -> None:
        """Takes all units of a command, those that are to be run, and whether one is
        run after the other.
        """
        self._names = unit_names(named)
        self._total, self._episodes = len(named), sum(len(unit.maps) for unit in named)
        self._waiting, self._in_turn = list(missing), in_turn
        self._left = len(missing)
        self._left_episodes = sum(len(unit.maps) for unit in missing)

    def progress(self, finished: Unit | None = None) -> Progress:
        """The progress, once a unit was finished; the first without one."""
        if finished is not None:
            self._left -= 1
            self._left_episodes -= len(finished.maps)
        done = len(self._waiting) - self._left
        doing = f"finished {self._names(finished)}" if finished is not None else ""
        if self._left and (self._in_turn or finished is None):
            doing = f"running {self._names(self._waiting[done])}"
        return Progress(
            self._total - self._left,
            self._total,
            doing=doing,
            size_done=self._episodes - self._left_episodes,
            size=self._episodes,
            sized="episodes",
        )


def _run_in(
    here: Path, folder: Path, unit: Unit, origin: Origin, settings: Settings
) -> tuple[Unit, dict[str, bytes]]:
    """Runs a unit in a process of this machine; gives it, and no files, which it wrote
    itself.
    """
    with chdir(here):
        run_unit(unit, folder, origin, settings)
    return unit, {}


# Why units that are there in part are run again, as `say` receives it.
_AGAIN = {
    "unrecorded": "are run again for recordings or steps that they lack",
    "unmeasured": "are run again for metrics that they lack ({})",
    "damaged": "are damaged and are run again; the first: {}",
    "changed": "are run again, since what their parts read changed: {}",
    "other": "were finished by other code or maps ({}) and are run again; "
    "--reuse-code takes units of other code",
}


def _missing(
    own: list[Unit],
    origins: Origins,
    folder: Path,
    reuse_code: bool,
    say: Say,
    is_here: bool,
) -> list[tuple[Unit, Origin]]:
    """Return what is to be run: units that are not finished, damaged, or not recorded
    as they are now to be.

    Args:
        own: units of this run.
        origins: what they come from now.
        folder: the run folder.
        reuse_code: take units of other code.
        say: receives how many units are run again, and why.
        is_here: units are run on this machine, so that what parts read can be compared
            with what is here.
    """
    missing: list[tuple[Unit, Origin]] = []
    counts: Counter[str] = Counter()
    details: dict[str, dict[str, None]] = defaultdict(dict)
    for unit in own:
        origin, makings = origins.of(unit), find_units(folder, unit)
        finished = _counting(makings, unit, origin, reuse_code)
        why, lines = _why_missing(folder, unit, origin, makings, finished)
        if not why and is_here and not reuse_code and finished:
            lines = changes_since(finished.about.get(TOUCHED, {}))
            why = "changed" if lines else ""
        if not why and finished and not finished.has(unit):
            why = "unrecorded"
        if not why:
            continue
        counts[why] += 1
        if why != "damaged" or not details[why]:
            details[why] |= dict.fromkeys(lines)
        kept = makings[0] if why == "unmeasured" else finished
        missing.append((replace(unit, record=_richest(unit, kept)), origin))
    if done := len(own) - len(missing):
        say(f"{done} of {len(own)} units were there already")
    for why, text in _AGAIN.items():
        if counts[why]:
            say(
                f"{counts[why]} of {len(own)} units "
                f"{text.format('; '.join(details[why]))}"
            )
    return missing


def _why_missing(
    folder: Path,
    unit: Unit,
    origin: Origin,
    makings: list[Finished],
    finished: Finished | None,
) -> tuple[str, list[str]]:
    """Return why a unit is not there as a whole, a key of `_AGAIN` or "new", with lines
    on it; else an empty key.
    """
    if finished is not None:
        damage = finished.damage()
        return ("damaged", damage[:1]) if damage else ("", [])
    path = unit_path(unit, origin.key(unit))
    if (folder / path).exists():
        return "damaged", [f"{path}: it cannot be read"]
    if not makings:
        return "new", []
    differences = _differences(makings[0], origin)
    if not differences and (
        columns := lacks_metrics(makings[0].about["code"], origin.code)
    ):
        return "unmeasured", [", ".join(columns)]
    return "other", differences


def _richest(unit: Unit, counts: Finished | None) -> Record:
    """What is recorded of a unit that is run again: no less than it has kept, however
    little is asked for.
    """
    return max(
        unit.record,
        counts.about["record"] if counts else unit.record,
        key=RECORDS.index,
    )


def _counting(
    known: list[Finished], unit: Unit, origin: Origin, reuse_code: bool
) -> Finished | None:
    """The making of a unit that counts: that of the code and maps of now, else, if
    asked for, of other code.
    """
    key, maps = origin.key(unit), list(origin.maps)
    counting = [
        finished
        for finished in known
        if finished.about["key"] == key
        or (
            reuse_code
            and finished.about["digests"] == maps
            and not lacks_metrics(finished.about["code"], origin.code)
        )
    ]
    return max(
        counting, key=lambda finished: finished.about["key"] == key, default=None
    )


def _counted(
    unit: Unit, origins: Origins, folder: Path, reuse_code: bool
) -> Finished | None:
    """The making of a unit that counts now; None where it is not finished."""
    return _counting(find_units(folder, unit), unit, origins.of(unit), reuse_code)


def _differences(finished: Finished, origin: Origin) -> list[str]:
    """What differs between the origin of a finished unit and another, in words."""
    maps = ["maps"] if finished.about["digests"] != list(origin.maps) else []
    return [*code_differences(finished.about["code"], origin.code), *maps]


def _check_steady(finished: list[Finished], is_here: bool) -> None:
    """Refuse units whose parts read different contents of one file, package or
    variable.

    Raises:
        ConfigError: If there are such, or if what they read is not here any more.
    """
    seen: dict[str, str] = {}
    changed: dict[str, None] = {}
    for one in finished:
        touched = one.about.get(TOUCHED, {})
        changed |= dict.fromkeys(unlike(seen, touched))
        seen |= touched
    changed |= dict.fromkeys(changes_since(seen)) if is_here else {}
    if changed:
        raise ConfigError(
            "Expected what parts read to stay the same during the run, got changes: "
            f"{'; '.join(changed)}. "
            "Give the run's command again; it runs the units again that read "
            "something else."
        )


def _finished(
    own: list[Unit], origins: Origins, folder: Path, reuse_code: bool
) -> tuple[list[tuple[Unit, Finished]], str]:
    """The makings of all units that count, and a line on those of other code; empty
    where there are none.

    Raises:
        ConfigError: one is not there any more.
    """
    found, reused = [], 0
    other: dict[str, None] = {}
    for unit in own:
        origin, counts = origins.of(unit), _counted(unit, origins, folder, reuse_code)
        if counts is None:
            raise ConfigError(
                f"Expected unit {unit.name} of condition {unit.condition.id} in "
                f"{folder}, got none: it was removed. "
                "Give its `benchnav-eval run` command again."
            )
        found.append((unit, counts))
        changed = changes_since(counts.about.get(TOUCHED, {})) if reuse_code else []
        if changed or counts.about["key"] != origin.key(unit):
            reused += 1
            other |= dict.fromkeys([*_differences(counts, origin), *changed])
    line = (
        f"{reused} of {len(own)} units were made by other code "
        f"({'; '.join(other)}); column `code` tells which rows"
    )
    return found, line if reused else ""
