"""Runs of suites: check the suite, run its unfinished units, and write tables.

A run folder stores finished units, each identified by its origin (`Origin.key`). The
command of a run resumes it; a different command extends it. A row does not depend on
the number of workers, the order of units, or interruptions.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from benchnav.core.device import gpu_name
from benchnav.core.errors import ConfigError
from benchnav.core.progress import Progress
from benchnav.core.store import Shard, sole_writer
from benchnav.core.touched import changed_entries, differing_entries
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
    missing_metrics,
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
from benchnav.eval.run.recordings import write_ground
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
    """Run the unfinished units of a suite, and yield the progress in units.

    Other units of an existing run remain unchanged. While any of them is unfinished,
    the run has no table, and `say` receives a line on this.

    Args:
        suite: suite to run.
        folder: the run folder; a run that the folder contains is resumed or extended.
        jobs: number of worker processes, or the address of a Dask cluster's scheduler,
            whose workers are used.
        overwrite: whether to delete an existing run first.
        settings: device, and time limit of planners.
        say: function that receives messages for the user, one line at a time.
        shard: shard of the units that is run; None for all units.
        reuse_code: whether to accept finished units that were run with other code; the
            run then has a note on them.

    Raises:
        ConfigError: If the folder contains other files, or the suite cannot be run.
        DatasetError: If a split or a map is missing in the dataset.
        BenchnavError: If the cluster cannot be reached, or the connection is lost.
    """
    with sole_writer(folder, str(folder)):
        uses_workers = jobs != 1 or settings.planner_limit_s > 0
        checked = check_suite(suite, uses_workers)
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
    """Run unfinished units in a folder locked by the caller; see `run_suite`."""
    scheduler = ""
    if isinstance(jobs, str):
        scheduler = jobs
        jobs = 1
    if scheduler:
        with connected(scheduler):  # raises before anything is deleted or written
            pass
    if work.settings.device == "cuda":
        say(f"running on {gpu_name(work.settings.device)}")
    if overwrite:
        drop(folder)
    requested, conditions, metrics = begin(work, folder, say)
    all_units = units(conditions, work.record, metrics)
    shard_units = all_units
    if work.shard is not None:
        of = work.shard.of
        shard_units = [unit for unit in all_units if unit.shard(of) == work.shard]
    named, others = _split_units(shard_units, requested)
    origins = work.settings.origins()
    is_local = not scheduler
    missing = _units_to_run(named, origins, folder, work.reuse_code, say, is_local)
    if not shard_units:
        say(f"shard {work.shard} contains none of the {len(all_units)} units")
    run: Any = partial(_run_into, folder.resolve())
    if scheduler:
        run = partial(run_on_worker, Path.cwd())
    calls: list[Any] = []
    for unit, origin in missing:
        calls.append(partial(run, unit, origin, work.settings))
    missing_units = [unit for unit, _ in missing]
    steps = _Steps(named, missing_units, in_turn=jobs == 1 and is_local)
    if named:
        yield steps.progress()
    for unit, files in run_calls(calls, jobs, scheduler):
        if scheduler:
            store_files(folder, unit, files)
        yield steps.progress(unit)
    if missing:
        say("measuring the planning time of a single robot")
    named_ids = {unit.condition.id for unit in named}
    measure_latencies(folder, named_ids, work.settings)
    ordered = in_table_order(named, conditions)
    finished, reused = _finished(ordered, origins, folder, work.reuse_code)
    if others:
        unfinished = []
        for unit in others:
            if _find_valid(unit, origins, folder, work.reuse_code) is None:
                unfinished.append(unit)
        if unfinished:
            write_errors(folder, finished)
            note_checksums(folder, [folder / ERRORS])
            if missing:  # An existing table lacks the new rows.
                (folder / EPISODES).unlink(missing_ok=True)
            say(_unfinished_line(folder, unfinished, len(conditions)))
            return
        ordered = in_table_order(shard_units, conditions)
        finished, reused = _finished(ordered, origins, folder, work.reuse_code)
    if not work.reuse_code:
        _check_unchanged([finished_unit for _, finished_unit in finished], is_local)
    if work.shard is not None:
        write_errors(folder, finished)
        note_checksums(folder, [folder / ERRORS])
        return
    align_steps(folder, all_units)
    finish_run(folder, finished, reused)
    note_checksums(folder, [folder / ERRORS])
    write_ground(folder)


def _split_units(
    shard_units: Sequence[Unit], conditions: Conditions
) -> tuple[list[Unit], list[Unit]]:
    """Return the units of the given conditions and extents, and all other units."""
    requested = {_key(unit) for unit in units(conditions)}
    named = [unit for unit in shard_units if _key(unit) in requested]
    others = [unit for unit in shard_units if _key(unit) not in requested]
    return named, others


def _key(unit: Unit) -> tuple[str, int, int, int]:
    return unit.condition.id, unit.seed, unit.realisation, unit.block


def _unfinished_line(folder: Path, units_: Sequence[Unit], conditions: int) -> str:
    """Return a line on the unfinished units of a run that this command did not request.

    Args:
        folder: the run folder.
        units_: unfinished units.
        conditions: number of conditions of the run.
    """
    n_unfinished = len({unit.condition.id for unit in units_})
    n_other = sum(bool(find_units(folder, unit)) for unit in units_)
    reason = ""
    if n_other:
        reason = f" ({n_other} of their units were run with other code or maps)"
    return (
        "all conditions of this command are finished, but "
        f"{n_unfinished} of {conditions} conditions of {folder} are unfinished{reason}, "
        "so that the run has no new table. Run the command that requested them, or "
        "read finished units with `report --partial`"
    )


class _Steps:
    """Progress of a command in units, with their names."""

    def __init__(
        self, named: Sequence[Unit], missing: Sequence[Unit], in_turn: bool
    ) -> None:
        """Store the requested units, those to run, and whether they run in turn."""
        self._names = unit_names(named)
        self._total = len(named)
        self._episodes = sum(len(unit.maps) for unit in named)
        self._missing = list(missing)
        self._in_turn = in_turn
        self._n_waiting = len(missing)
        self._waiting_episodes = sum(len(unit.maps) for unit in missing)

    def progress(self, finished: Unit | None = None) -> Progress:
        """Return the progress after a unit was finished; None before the first unit."""
        doing = ""
        if finished is not None:
            self._n_waiting -= 1
            self._waiting_episodes -= len(finished.maps)
            doing = f"finished {self._names(finished)}"
        if self._n_waiting and (self._in_turn or finished is None):
            next_unit = self._missing[-self._n_waiting]
            doing = f"running {self._names(next_unit)}"
        return Progress(
            self._total - self._n_waiting,
            self._total,
            doing=doing,
            size_done=self._episodes - self._waiting_episodes,
            size=self._episodes,
            sized="episodes",
        )


def _run_into(
    folder: Path, unit: Unit, origin: Origin, settings: Settings
) -> tuple[Unit, dict[str, bytes]]:
    """Run a unit in a process of this machine, which also writes the files."""
    run_unit(unit, folder, origin, settings)
    return unit, {}


# Texts for the user by reason for which existing units are run again.
_RERUN_TEXTS = {
    "unrecorded": "have no recordings or steps and are run again",
    "unmeasured": "have no values of new metrics ({}) and are run again",
    "damaged": "are damaged and are run again; the first: {}",
    "changed": "are run again, since their parts read files or variables that have "
    "changed: {}",
    "other": "were run with other code or maps ({}) and are run again; pass "
    "--reuse-code to use units of other code",
}


def _units_to_run(
    shard_units: list[Unit],
    origins: Origins,
    folder: Path,
    reuse_code: bool,
    say: Say,
    is_local: bool,
) -> list[tuple[Unit, Origin]]:
    """Return the units to run: unfinished, damaged, changed or unrecorded units.

    Args:
        shard_units: requested units.
        origins: current origins of units.
        folder: the run folder.
        reuse_code: whether to accept units that were run with other code.
        say: function that receives the number of units that are run again, with
            reasons.
        is_local: whether units run on this machine. If so, the contents that parts have
            read are compared with the files of this machine.
    """
    missing: list[tuple[Unit, Origin]] = []
    counts: Counter[str] = Counter()
    details: dict[str, dict[str, None]] = defaultdict(dict)
    for unit in shard_units:
        origin = origins.of(unit)
        finished_units = find_units(folder, unit)
        finished = _valid_file(finished_units, unit, origin, reuse_code)
        reason, lines = _why_missing(folder, unit, origin, finished_units, finished)
        if not reason and is_local and not reuse_code and finished:
            lines = changed_entries(finished.metadata.get(TOUCHED, {}))
            reason = "changed" if lines else ""
        if not reason and finished and not finished.has(unit):
            reason = "unrecorded"
        if not reason:
            continue
        counts[reason] += 1
        if reason != "damaged" or not details[reason]:
            details[reason] |= dict.fromkeys(lines)
        finished_unit = finished_units[0] if reason == "unmeasured" else finished
        record = _max_record(unit, finished_unit)
        missing.append((replace(unit, record=record), origin))
    n_units = len(shard_units)
    n_done = n_units - len(missing)
    if n_done:
        say(f"{n_done} of {n_units} units were already finished")
    for reason, template in _RERUN_TEXTS.items():
        if counts[reason]:
            text = template.format("; ".join(details[reason]))
            say(f"{counts[reason]} of {n_units} units {text}")
    return missing


def _why_missing(
    folder: Path,
    unit: Unit,
    origin: Origin,
    finished_units: list[Finished],
    finished_unit: Finished | None,
) -> tuple[str, list[str]]:
    """Return the reason for which a unit is run, and details.

    The reason is a key of `_RERUN_TEXTS` or "new". It is empty if the unit is finished.
    `finished_units` are all files of the unit, `finished_unit` is the valid one.
    """
    if finished_unit is not None:
        damage = finished_unit.damage()
        reason = "damaged" if damage else ""
        return reason, damage[:1]
    path = unit_path(unit, origin.key(unit))
    if (folder / path).exists():
        return "damaged", [f"{path}: it cannot be read"]
    if not finished_units:
        return "new", []
    newest = finished_units[0]
    differences = _differences(newest, origin)
    columns = missing_metrics(newest.metadata["code"], origin.code)
    if columns and not differences:
        return "unmeasured", [", ".join(columns)]
    return "other", differences


def _max_record(unit: Unit, finished_unit: Finished | None) -> Record:
    """Return the higher level of two records: of the request and of a finished unit."""
    stored = finished_unit.metadata["record"] if finished_unit else unit.record
    return max(unit.record, stored, key=RECORDS.index)


def _valid_file(
    finished_units: list[Finished], unit: Unit, origin: Origin, reuse_code: bool
) -> Finished | None:
    """Return the file of a unit with the current maps and code, or None.

    With `reuse_code`, the code may differ.
    """
    key = origin.key(unit)
    maps = list(origin.maps)
    for finished_unit in finished_units:
        if finished_unit.metadata["key"] == key:
            return finished_unit
    if not reuse_code:
        return None
    for finished_unit in finished_units:
        has_metrics = not missing_metrics(finished_unit.metadata["code"], origin.code)
        if finished_unit.metadata["digests"] == maps and has_metrics:
            return finished_unit
    return None


def _find_valid(
    unit: Unit, origins: Origins, folder: Path, reuse_code: bool
) -> Finished | None:
    """Return the valid file of a unit in a run folder, or None."""
    return _valid_file(find_units(folder, unit), unit, origins.of(unit), reuse_code)


def _differences(finished: Finished, origin: Origin) -> list[str]:
    """Describe the differences between the origin of a finished unit and `origin`."""
    lines = code_differences(finished.metadata["code"], origin.code)
    if finished.metadata["digests"] != list(origin.maps):
        lines.append("maps")
    return lines


def _check_unchanged(finished: list[Finished], is_local: bool) -> None:
    """Reject units whose parts read different contents of a file, package or variable.

    Raises:
        ConfigError: If contents differ between units, or have changed since.
    """
    seen: dict[str, str] = {}
    changed: dict[str, None] = {}
    for finished_unit in finished:
        touched = finished_unit.metadata.get(TOUCHED, {})
        changed |= dict.fromkeys(differing_entries(seen, touched))
        seen |= touched
    if is_local:
        changed |= dict.fromkeys(changed_entries(seen))
    if changed:
        raise ConfigError(
            "Expected files, packages and variables that parts read not to change "
            f"during the run, got changes: {'; '.join(changed)}. Repeat the command of "
            "the run, which runs the units with other contents again."
        )


def _finished(
    shard_units: list[Unit], origins: Origins, folder: Path, reuse_code: bool
) -> tuple[list[tuple[Unit, Finished]], str]:
    """Return the valid files of all units, and a line on units of other code, or "".

    Raises:
        ConfigError: If a unit was removed.
    """
    counted = []
    n_reused = 0
    changes: dict[str, None] = {}
    for unit in shard_units:
        origin = origins.of(unit)
        finished_unit = _find_valid(unit, origins, folder, reuse_code)
        if finished_unit is None:
            raise ConfigError(
                f"Expected unit {unit.name} of condition {unit.condition.id} in "
                f"{folder}, got none, because the unit was removed. Repeat the "
                "`benchnav-eval run` command of this folder."
            )
        counted.append((unit, finished_unit))
        changed = []
        if reuse_code:
            changed = changed_entries(finished_unit.metadata.get(TOUCHED, {}))
        if changed or finished_unit.metadata["key"] != origin.key(unit):
            n_reused += 1
            changes |= dict.fromkeys([*_differences(finished_unit, origin), *changed])
    if not n_reused:
        return counted, ""
    line = (
        f"{n_reused} of {len(shard_units)} units were run with other code "
        f"({'; '.join(changes)}); the column `code` identifies the code of each row"
    )
    return counted, line
