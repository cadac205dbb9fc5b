"""Running a suite into a run folder: unit by unit, in parallel, to be resumed or extended at any moment.

A row does not depend on the number of workers, on the order of units, or on interruptions.
"""

import json
import os
import secrets
import traceback
import warnings
from collections.abc import Collection, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import chdir, nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import joblib
import pandas as pd
import torch

from benchnav.core.device import find_device, gpu_name
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.settings import plain
from benchnav.core.store import Shard, sole_writer
from benchnav.core.workers import end_with
from benchnav.eval.experiment.condition import Condition, check_labels
from benchnav.eval.experiment.keep import Keep
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent, Unit, in_table_order, units
from benchnav.eval.folder import provenance
from benchnav.eval.folder.changes import changed_options
from benchnav.eval.folder.folder import (
    EPISODES,
    FORMAT,
    FORMAT_VERSION,
    RUN,
    SEAL,
    about_unit,
    caveats,
    finish_run,
    has_all,
    kept,
    open_run,
    write_errors,
    write_run,
    write_unit,
)
from benchnav.eval.folder.steps import align_steps, write_steps
from benchnav.eval.run.check import check_suite
from benchnav.eval.run.check_world import Say
from benchnav.eval.run.cluster import connected, run_on_cluster
from benchnav.eval.run.driven_ground import keep_ground
from benchnav.eval.run.episode import (
    Block,
    PredictionError,
    build,
    one_thread,
    read_block,
    simulate,
    time_budgets,
)
from benchnav.eval.run.latency import measure_latencies
from benchnav.eval.run.recorder import Recorder
from benchnav.eval.run.rows import episode_rows, error_rows, step_table
from benchnav.planning.planners.planner import what_it_follows
from benchnav.planning.world.outcome import Outcome

Conditions = dict[str, tuple[Condition, Extent]]


@dataclass(frozen=True, kw_only=True)
class Work:
    """What a command asks of a run.

    Args:
        suite: as it was written, for `run.json`.
        conditions: by id, with how often each is to be run.
        keep: what is recorded of episodes, and of which the steps are stored.
        planner_limit_s: time limit of each call of a planner; 0 for none.
        shard: which share of the units is run; None for all.
        device: where all is computed, "cpu" or "cuda".
        dropped: pairs of planner and robot that were left out, as `check.Checked` has them.
        warnings: what readers of the results should know.
        hypotheses: from `fix_hypotheses`; empty where there are none.
    """

    suite: Mapping[str, Any]
    conditions: Conditions
    keep: Keep
    planner_limit_s: float = 0.0
    shard: Shard | None = None
    device: str = "cpu"
    dropped: tuple[Mapping[str, str], ...] = ()
    warnings: tuple[str, ...] = ()
    hypotheses: Mapping[str, Any] = field(default_factory=dict)


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
    shard: Shard | None = None,
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
        checked = check_suite(suite, workers.elsewhere or planner_limit_s > 0)
        for line in caveats({"warnings": checked.warnings, "dropped": checked.dropped}):
            say(line)
        work = Work(
            suite=plain(suite),
            conditions=checked.conditions,
            dropped=checked.dropped,
            warnings=checked.warnings,
            hypotheses=checked.hypotheses,
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
        about, conditions = _begin(work, folder, say)
        every = units(conditions, work.keep)
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
    _measure_latencies(folder, {unit.condition.id for unit in own})
    if work.shard is None:
        align_steps(folder, every)
        finish_run(folder, in_table_order(every, conditions))
        keep_ground(folder)
    else:
        write_errors(folder, in_table_order(own, conditions), about["run_id"])


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
            write_unit(folder, unit, _grouped(rows, read_block(unit, run_id)), about)
            return
        watched = unit.keep.watched(len(unit.maps))
        recorder = Recorder(unit, problem, simulation, read_block(unit, run_id, place).terrain, watched)
        watch = recorder.watch if watched else None
        episodes, compiled = simulate(unit, problem, simulation, watch, recorder.every, planner_limit_s)
    succeeded = (episodes.outcome == Outcome.SUCCESS).tolist()
    for member in unit.keep.recorded(succeeded):
        recorder.write(episodes, member, folder)
    if stored := unit.keep.with_steps(succeeded):
        write_steps(folder, unit, step_table(unit, problem, episodes, stored))
    about |= {"traceback": episodes.traceback, "errors": sorted({e for e in episodes.errors if e})}
    block = read_block(unit, run_id, place)
    reference = block.places.reference_time_s.cpu().numpy()
    rejected_draws = (simulation.attempts - 1).tolist()
    rows = episode_rows(unit, problem, episodes, reference, rejected_draws, compiled)
    write_unit(folder, unit, _grouped(rows, block), about)


def _grouped(rows: pd.DataFrame, block: Block) -> pd.DataFrame:
    """Rows of a unit with the groups of their maps."""
    rows.insert(rows.columns.get_loc("map") + 1, "group", block.groups)
    return rows


def _measure_latencies(folder: Path, chosen: Collection[str]) -> None:
    """Measures the planners of some conditions alone and writes it into `run.json`, where it is not there yet."""
    run = open_run(folder)
    entries = run.about["conditions"]
    known = {i: entry["latency"] for i, entry in entries.items() if "latency" in entry}
    conditions = {i: entry for i, entry in run.conditions.items() if i in chosen}
    given = run.about["run_id"], run.about["planner_limit_s"], run.about["device"]
    latencies = measure_latencies(conditions, known, *given)
    if latencies != {i: about for i, about in known.items() if i in conditions}:
        for condition_id, latency in latencies.items():
            entries[condition_id]["latency"] = latency
        write_run(folder, run.about)


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
    """Empties a run folder, which stays what it is: a link, another file system, the folder that the user is in."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        open_run(folder)  # Only what is a run folder may be dropped.
        place = folder.resolve()
        with TemporaryDirectory(dir=place.parent, prefix=f".{place.name}.dropped-") as dropped:
            # `run.json` last, so that a kill leaves a run that can be dropped or gone on with.
            for path in sorted(place.iterdir(), key=lambda path: path.name == RUN):
                os.replace(path, Path(dropped, path.name))


def _begin(work: Work, folder: Path, say: Say) -> tuple[dict[str, Any], Conditions]:
    """Writes `run.json`, or extends the one that is there; gives what it holds and all conditions."""
    if not (folder / RUN).exists():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ConfigError(
                f"Expected `out` to be a new folder or a run folder, but {folder} holds something else."
            )
        about = _about({"run_id": secrets.token_hex(8)}, work, work.conditions)
        write_run(folder, about)
        return about, work.conditions
    earlier = open_run(folder)
    if earlier.shard != work.shard:
        raise ConfigError(
            f"Expected `out` to be new or to hold {_share(work.shard)}, but {folder} holds "
            f"{_share(earlier.shard)}. Choose another `out`."
        )
    _check_hypotheses(work.hypotheses, earlier.about, folder)
    check_labels(condition for known in (earlier, work) for condition, _ in known.conditions.values())
    conditions = _joined(earlier.conditions, work.conditions)
    now = _about(earlier.about, work, conditions)
    changed = provenance.differences(earlier.about, now)
    if changed:
        raise ConfigError(
            f"Expected `out` to be new or a run of the same code and data, but since {folder} was begun these "
            f"changed: {'; '.join(changed)}. Choose another `out`{_or_its_device(earlier.about, now)}, or pass "
            "--overwrite."
        )
    if conditions != earlier.conditions:
        new = len(conditions) - len(earlier.conditions)
        more = {0: "by more episodes", 1: "by 1 new condition"}.get(new, f"by {new} new conditions")
        say(f"{folder} is extended {more}")
        (folder / EPISODES).unlink(missing_ok=True)  # until all that is asked for is there
        write_run(folder, now)
    elif now != {name: value for name, value in earlier.about.items() if name not in (SEAL, "tables")}:
        write_run(folder, {**now, "tables": earlier.about.get("tables", {})})
    return now, conditions


def _check_hypotheses(wanted: Mapping[str, Any], earlier: Mapping[str, Any], folder: Path) -> None:
    """Refuses hypotheses that a run was not begun with: they would be written after what they are tested by."""
    fixed = earlier.get("hypotheses", {}).get("digest", "none")
    if wanted and wanted["digest"] != fixed:
        raise ConfigError(
            f"Expected the `hypotheses` that {folder} was begun with (digest {fixed}), got others (digest "
            f"{wanted['digest']}), which would be written after its first results. Leave `hypotheses` out to go on, or "
            "choose another `out`."
        )


def _or_its_device(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    device = earlier["device"]
    return "" if device == now["device"] else f", pass --device {device}"


def _share(shard: Shard | None) -> str:
    return "a whole run" if shard is None else f"shard {shard} of one"


def _joined(earlier: Conditions, wanted: Conditions) -> Conditions:
    """Every condition of both, each at the greater extent."""
    joined = dict(earlier)
    for condition_id, (condition, extent) in wanted.items():
        known = joined.get(condition_id)
        joined[condition_id] = (condition, known[1].union(extent) if known else extent)
    return joined


def _check_unchanged(folder: Path) -> None:
    """Refuses to make one table of rows of which some may be of other code than others."""
    run = open_run(folder)
    about = run.about
    now = {**about, **provenance.describe(run.conditions)}
    changed = provenance.differences(about, json.loads(json.dumps(now)))
    if changed:
        raise ConfigError(
            f"While {folder} was running these changed: {'; '.join(changed)}. Its rows may be of either. "
            "Run it again with --overwrite."
        )


def _about(earlier: Mapping[str, Any], work: Work, conditions: Conditions) -> dict[str, Any]:
    """What `run.json` is to hold, of which the folder may hold an earlier state; of a new run that is its id alone."""
    known = earlier.get("conditions", {})
    entries = {
        condition_id: {
            **{"value": condition.value, "labels": condition.labels, **_notes(condition), **extent.to_dict()},
            **{key: known[condition_id][key] for key in ("latency",) if key in known.get(condition_id, {})},
        }
        for condition_id, (condition, extent) in conditions.items()
    }
    about = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "run_id": earlier["run_id"],
        **({"shard": asdict(work.shard)} if work.shard else {}),
        "suite": dict(work.suite),
        **({"hypotheses": fixed} if (fixed := earlier.get("hypotheses", work.hypotheses)) else {}),
        "conditions": entries,
        "dropped": provenance.join(earlier.get("dropped", ()), work.dropped),
        "warnings": provenance.join(earlier.get("warnings", ()), work.warnings),
        "planner_limit_s": work.planner_limit_s,
        "device": work.device,
        "gpu": gpu_name(work.device),
        **provenance.describe(conditions),
        "machine": provenance.describe_machine(),
        "commands": provenance.command_lines(earlier.get("commands", ())),
        "history": provenance.extend_history(earlier.get("history", ()), work.suite),
    }
    return json.loads(json.dumps(about))


def _notes(condition: Condition) -> dict[str, Any]:
    """What tables say of a condition's planner."""
    planner = condition.make_planner()
    task, remarks = condition.make_task(), getattr(planner, "remarks", None)
    return {
        "follows": what_it_follows(planner, task),
        "remarks": list(remarks(task)) if remarks else [],
        "changed": changed_options(condition.planner),
    }
