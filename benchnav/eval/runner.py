"""Running a suite into a run folder: unit by unit, in parallel, to be resumed or extended at any moment.

A row does not depend on the number of workers, on the order of units, or on interruptions.
"""

import json
import os
import secrets
import shutil
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import chdir
from pathlib import Path
from typing import Any

import joblib

from benchnav.errors import ConfigError
from benchnav.eval.driven_ground import keep_ground
from benchnav.eval.recorder import Recorder
from benchnav.eval.run import provenance
from benchnav.eval.run.changes import changed_options
from benchnav.eval.run.check import check_suite
from benchnav.eval.run.episode import (
    PredictionError,
    build,
    one_thread,
    read_block,
    simulate,
    time_budgets,
)
from benchnav.eval.run.folder import (
    FORMAT,
    FORMAT_VERSION,
    RUN,
    about_unit,
    has_all,
    merge_tables,
    open_run,
    write_unit,
)
from benchnav.eval.run.rows import episode_rows, error_rows
from benchnav.eval.run.steps import align_steps, step_table, write_steps
from benchnav.eval.run.unit import Extent, Unit, in_table_order, units
from benchnav.eval.suite import Suite
from benchnav.eval.trial import Trial, check_labels
from benchnav.files import sole_writer, write_text
from benchnav.planning.world.outcome import Outcome

Trials = dict[str, tuple[Trial, Extent]]


def run_suite(
    suite: Suite,
    folder: Path,
    jobs: int = 1,
    overwrite: bool = False,
    planner_limit_s: float = 0.0,
    say: Callable[[str], None] = lambda line: None,
) -> Iterator[tuple[int, int]]:
    """Runs what is not finished of a suite, yielding (units done, units in all); to be iterated to the end.

    Args:
        suite: what is evaluated.
        folder: the run folder; it may hold a run, which is gone on with or extended.
        jobs: worker processes.
        overwrite: drop the run that is there.
        planner_limit_s: time limit of each call of a planner; 0 for none.
        say: is told what a user should know, a line at a time.

    Raises:
        ConfigError: the folder holds something else or a run of other code, or the suite cannot be run.
        DatasetError: the dataset lacks what the suite asks for.
    """
    with sole_writer(folder, str(folder)):
        wanted = check_suite(suite, jobs > 1 or planner_limit_s > 0, say)
        if overwrite:
            _drop(folder)
        run_id, trials = _begin(suite, folder, wanted, planner_limit_s, say)
        every = units(trials, suite.keep)
        known = [(unit, about_unit(folder, unit, run_id)) for unit in every]
        missing = [unit for unit, about in known if not has_all(about, unit)]
        done = len(every) - len(missing)
        if done:
            say(f"{done} of {len(every)} units were there already")
        if again := sum(about is not None and not has_all(about, unit) for unit, about in known):
            say(f"{again} finished units are run again for recordings or steps that they were not asked for")
        yield done, len(every)
        for _ in _run_all(missing, folder, run_id, jobs, planner_limit_s):
            done += 1
            yield done, len(every)
        _check_unchanged(folder)
        align_steps(folder, every)
        merge_tables(folder, in_table_order(every, trials), run_id)
        keep_ground(folder)


def run_unit(unit: Unit, folder: Path, run_id: str, planner_limit_s: float = 0.0) -> None:
    """Runs one unit on one thread and writes its file, and before it its recordings and steps.

    Args:
        unit: what is run.
        folder: the run folder.
        run_id: of the run that it belongs to.
        planner_limit_s: time limit of each call of the planner; 0 for none.
    """
    about: dict[str, Any] = {"run_id": run_id, "traceback": "", "errors": []}
    with one_thread():
        try:
            problem, simulation = build(unit, run_id)
        except PredictionError as error:
            about |= {"traceback": traceback.format_exc(), "errors": [str(error)]}
            rows = error_rows(unit, time_budgets(unit, run_id), str(error))
            write_unit(folder, unit, rows, about)
            return
        watched = unit.keep.watched(len(unit.instances))
        recorder = Recorder(unit, problem, simulation, read_block(unit, run_id).terrain, watched)
        watch = recorder.watch if watched else None
        episodes, compiled = simulate(unit, problem, simulation, watch, recorder.every, planner_limit_s)
    succeeded = (episodes.outcome == Outcome.SUCCESS).tolist()
    for member in unit.keep.recorded(succeeded):
        recorder.write(episodes, member, folder)
    if stored := unit.keep.with_steps(succeeded):
        write_steps(folder, unit, step_table(unit, problem, episodes, stored))
    about |= {"traceback": episodes.traceback, "errors": sorted({e for e in episodes.errors if e})}
    reference = read_block(unit, run_id).places.reference_time_s.numpy()
    redrawn = (simulation.attempts - 1).tolist()
    rows = episode_rows(unit, problem, episodes, reference, redrawn, compiled)
    write_unit(folder, unit, rows, about)


def _run_all(
    missing: list[Unit], folder: Path, run_id: str, jobs: int, planner_limit_s: float
) -> Iterator[None]:
    # Workers may be older than this call, so that they are told where names of files begin.
    here, target = Path.cwd(), folder.resolve()
    calls = (joblib.delayed(_run_at)(here, unit, target, run_id, planner_limit_s) for unit in missing)
    finished = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")(calls)
    for _ in missing:
        with warnings.catch_warnings():
            # A worker whose memory has grown is replaced; that is no concern of a user's.
            warnings.filterwarnings("ignore", message="A worker stopped while some jobs were given")
            next(finished)
        yield


def _run_at(here: Path, unit: Unit, folder: Path, run_id: str, planner_limit_s: float) -> None:
    with chdir(here):
        run_unit(unit, folder, run_id, planner_limit_s)


def _drop(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        open_run(folder)  # Only what is a run folder may be dropped.
        dropped = folder.with_name(f".{folder.name}.{os.getpid()}.dropped")
        os.replace(folder, dropped)
        shutil.rmtree(dropped)


def _begin(
    suite: Suite, folder: Path, wanted: Trials, planner_limit_s: float, say: Callable[[str], None]
) -> tuple[str, Trials]:
    """Writes `run.json`, or extends the one that is there; gives the run's id and all its trials."""
    if not (folder / RUN).exists():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ConfigError(
                f"Expected `out` to be a new folder or a run folder, but {folder} holds something else."
            )
        about = _about(secrets.token_hex(8), suite, wanted, planner_limit_s, [])
        write_text(folder / RUN, json.dumps(about, indent=1))
        return about["run_id"], wanted
    earlier = open_run(folder)
    if earlier.version < FORMAT_VERSION:
        raise ConfigError(
            f"Expected `out` to be new or a run of format version {FORMAT_VERSION}, but {folder} is of version "
            f"{earlier.version}, which can be reported and not gone on with. Choose another `out`."
        )
    trials = _joined(earlier.trials, wanted)
    check_labels(trial for trial, _ in trials.values())
    now = _about(earlier.about["run_id"], suite, trials, planner_limit_s, earlier.about["commands"])
    changed = provenance.differences(earlier.about, now)
    if changed:
        raise ConfigError(
            f"Expected `out` to be new or a run of the same code and data, but since {folder} was begun these "
            f"changed: {'; '.join(changed)}. Choose another `out`, or pass --overwrite."
        )
    if trials != earlier.trials:
        new = len(trials) - len(earlier.trials)
        say(f"{folder} is extended: {new} new trials" if new else f"{folder} is extended by more episodes")
        write_text(folder / RUN, json.dumps(now, indent=1))
    return now["run_id"], trials


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


def _about(
    run_id: str, suite: Suite, trials: Trials, planner_limit_s: float, commands: list[str]
) -> dict[str, Any]:
    entries = {
        trial_id: {"value": trial.value, "labels": trial.labels, **_notes(trial), **extent.to_dict()}
        for trial_id, (trial, extent) in trials.items()
    }
    about = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "run_id": run_id,
        "suite": suite.to_dict(),
        "trials": entries,
        "planner_limit_s": planner_limit_s,
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
        "remarks": list(remarks(trial.make_task().robot)) if remarks else [],
        "changed": changed_options(trial.planner),
    }
