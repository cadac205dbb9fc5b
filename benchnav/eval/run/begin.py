"""Requested work of a command, and `run.json` of a new or extended run."""

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchnav.core import registry
from benchnav.core.device import gpu_name
from benchnav.core.errors import ConfigError
from benchnav.core.registry import NO_DEFAULT, Part
from benchnav.core.store import Shard
from benchnav.eval.experiment.condition import (
    Condition,
    check_labels,
    differences,
    merge,
)
from benchnav.eval.experiment.metrics import NamedMetric, add_metric, metrics_of_run
from benchnav.eval.experiment.suite import Record
from benchnav.eval.experiment.unit import Conditions
from benchnav.eval.folder import provenance
from benchnav.eval.folder.run_folder import (
    EPISODES,
    FORMAT,
    FORMAT_VERSION,
    RUN,
    Run,
    dropped_labels,
    is_taken,
    open_run,
    write_run,
)
from benchnav.eval.run.check import Checked, Say
from benchnav.eval.run.unit import Settings


@dataclass(frozen=True, kw_only=True)
class Work(Checked):
    """A checked suite, with the other options of a command.

    Args:
        suite: the suite as the user wrote it, for `run.json`.
        record: data of episodes that are stored in addition to rows.
        settings: settings of units.
        shard: shard of the units that is run; None for all units.
        reuse_code: whether to accept finished units that were run with other code.
    """

    suite: Mapping[str, Any]
    record: Record
    settings: Settings
    shard: Shard | None = None
    reuse_code: bool = False


def begin(
    work: Work, folder: Path, say: Say
) -> tuple[Conditions, Conditions, tuple[Part, ...]]:
    """Write `run.json`, or extend an existing one.

    Args:
        work: the requested work.
        folder: the run folder.
        say: function that receives messages for the user, one line at a time.

    Returns:
        The requested conditions, all conditions of the run, and the run's metrics in
        addition to the built-in ones.

    Raises:
        ConfigError: If the folder contains other files, or a run that the requested
            work cannot extend.
    """
    if not (folder / RUN).exists():
        if is_taken(folder):
            raise ConfigError(
                f"Expected `out` to be a new folder or a run folder, got {folder}, "
                "which is neither. Choose another `out`."
            )
        write_run(folder, _about({}, work, work.conditions))
        return work.conditions, work.conditions, _parts(work.metrics)
    earlier = open_run(folder)
    _check_extends(work, earlier)
    metrics = list(metrics_of_run(earlier.manifest))
    n_metrics = len(metrics)
    for metric in work.metrics:
        metrics = add_metric(metrics, metric)
    work = replace(work, metrics=tuple(metrics))
    new_names = [metric.quantity.name for metric in metrics[n_metrics:]]
    if new_names:
        noun = "metric" if len(new_names) == 1 else "metrics"
        say(f"{folder} is extended by {noun} {', '.join(new_names)}")
        (folder / EPISODES).unlink(missing_ok=True)
    requested, conditions = _merged(work.conditions, earlier.conditions)
    if conditions != earlier.conditions:
        n_new = len(conditions.keys() - earlier.conditions.keys())
        texts = {0: "more episodes", 1: "1 new condition"}
        extension = texts.get(n_new, f"{n_new} new conditions")
        say(f"{folder} is extended by {extension}")
        # The table is written again when all requested units are finished.
        (folder / EPISODES).unlink(missing_ok=True)
    now = _about(earlier.manifest, work, conditions)
    if now != earlier.manifest:
        write_run(folder, now)
    return requested, conditions, _parts(metrics)


def _parts(metrics: Iterable[NamedMetric]) -> tuple[Part, ...]:
    return tuple(metric.part for metric in metrics)


def _merged(new: Conditions, earlier: Conditions) -> tuple[Conditions, Conditions]:
    """Merge new conditions into the conditions of a run.

    A new condition that differs from an earlier one only in unused settings is merged
    into the earlier one.

    Returns:
        The new conditions after merging, and all conditions of the run.
    """
    conditions = dict(earlier)
    requested = {}
    ids_by_rows = {}
    for condition_id, (condition, _) in reversed(conditions.items()):
        ids_by_rows[condition.rows_id] = condition_id
    for condition_id, (condition, extent) in new.items():
        run_id = condition_id
        if condition_id not in conditions:
            run_id = ids_by_rows.get(condition.rows_id, condition_id)
        old_condition, old_extent = conditions.get(run_id, (condition, extent))
        representative = condition if condition.id == run_id else old_condition
        merged = merge(representative, (old_condition, condition))
        requested[run_id] = merged, extent
        conditions[run_id] = merged, old_extent.union(extent)
    return requested, conditions


def drop(folder: Path) -> None:
    """Delete the contents of a run folder, but not the folder.

    The folder may be a link, a file system's root or the working folder.
    """
    if is_taken(folder):
        open_run(folder)  # Raises if it is no run folder, which must not be emptied.
        target = folder.resolve()
        prefix = f".{target.name}.dropped-"
        with TemporaryDirectory(dir=target.parent, prefix=prefix) as dropped:
            # `run.json` is moved last, so that an interrupted call can be repeated.
            for path in sorted(target.iterdir(), key=lambda path: path.name == RUN):
                os.replace(path, Path(dropped, path.name))


def _check_extends(work: Work, earlier: Run) -> None:
    """Reject an existing run that the requested work cannot extend.

    Raises:
        ConfigError: If shards or hypotheses differ, the run cannot be resumed, or two
            settings have the same label.
    """
    folder = earlier.folder
    if earlier.shard != work.shard:
        raise ConfigError(
            f"Expected `out` to be new or to contain {_in_words(work.shard)}, got "
            f"{folder}, which contains {_in_words(earlier.shard)}. Choose another "
            "`out`."
        )
    check_resumable(earlier)
    # New hypotheses would be fixed after the results on which they are tested.
    fixed = earlier.manifest.get("hypotheses", {}).get("digest", "none")
    if work.hypotheses and work.hypotheses["digest"] != fixed:
        raise ConfigError(
            f"Expected the `hypotheses` that were fixed when {folder} was begun "
            f"(digest {fixed}), got different ones (digest "
            f"{work.hypotheses['digest']}). Leave `hypotheses` out to resume the run, "
            "or choose another `out`."
        )
    entries = [*earlier.conditions.values(), *work.conditions.values()]
    check_labels([condition for condition, _ in entries])


def check_resumable(run: Run) -> None:
    """Reject a run with parts that were objects of one process.

    Args:
        run: opened run folder.

    Raises:
        ConfigError: If the run has such parts.
    """
    parts: list[str] = []
    for entry in run.manifest["conditions"].values():
        parts += entry.get("unreproducible", ())
    for entry in run.manifest.get("metrics", ()):
        if "unreproducible" in entry:
            parts.append(f"metric {entry['quantity']['name']}")
    if parts:
        raise ConfigError(
            f"Expected a run that can be resumed, got {run.folder}, whose {parts[0]} "
            "was a Python object that existed only in the process that began the run. "
            "Evaluate the suite into a new folder."
        )


def _in_words(shard: Shard | None) -> str:
    return "an unsharded run" if shard is None else f"shard {shard} of a run"


def _about(
    earlier: Mapping[str, Any], work: Work, conditions: Conditions
) -> dict[str, Any]:
    """Return the contents of `run.json`.

    Args:
        earlier: earlier contents; empty for a new run.
        work: the requested work.
        conditions: all conditions of the run.
    """
    earlier_entries = earlier.get("conditions", {})
    entries = {}
    for condition_id, (condition, extent) in conditions.items():
        entry = {
            "value": condition.value,
            "labels": condition.labels,
            **_notes(condition),
        }
        if condition.stands_for:
            entry["stands_for"] = condition.stands_for
        entry["seeds"] = extent.seeds
        entry["draws"] = extent.draws
        earlier_entry = earlier_entries.get(condition_id, {})
        if "latency" in earlier_entry:
            entry["latency"] = earlier_entry["latency"]
        entries[condition_id] = entry
    hypotheses = earlier.get("hypotheses", work.hypotheses)
    dropped = [*earlier.get("dropped", ()), *work.dropped]
    manifest: dict[str, Any] = {"format": FORMAT, "format_version": FORMAT_VERSION}
    if work.shard:
        manifest["shard"] = asdict(work.shard)
    manifest["suite"] = dict(work.suite)
    if hypotheses:
        manifest["hypotheses"] = hypotheses
    if work.metrics:
        manifest["metrics"] = [metric.entry for metric in work.metrics]
    manifest["conditions"] = entries
    manifest["dropped"] = _still_dropped(dropped, conditions)
    manifest["warnings"] = provenance.join(earlier.get("warnings", ()), work.warnings)
    manifest |= asdict(work.settings)
    manifest["gpu"] = gpu_name(work.settings.device)
    manifest["datasets"] = provenance.describe_datasets(conditions)
    manifest["machine"] = provenance.describe_machine()
    history = earlier.get("history", ())
    manifest["history"] = provenance.extend_history(history, work.suite)
    for name in ("codes", "reused", "tables"):
        if name in earlier:
            manifest[name] = earlier[name]
    return json.loads(json.dumps(manifest))


def _still_dropped(
    dropped: Iterable[dict[str, str]], conditions: Conditions
) -> list[dict[str, str]]:
    """Return the left-out combinations that no condition covers, without repetitions.

    After a change of its parts, a combination that was left out may have been run.
    """
    run_labels = [set(condition.labels.items()) for condition, _ in conditions.values()]
    still_dropped = []
    for entry in dropped:
        labels = set(dropped_labels(entry).items())
        if not any(labels <= condition_labels for condition_labels in run_labels):
            still_dropped.append(entry)
    return provenance.join(still_dropped)


def _notes(condition: Condition) -> dict[str, Any]:
    """Return notes on a condition's planner, which tables show."""
    planner = condition.planner.object
    task = condition.task
    remarks = list(planner.remarks(task))
    for kind, labels in condition.stands_for.items():
        remarks.append(
            f"One row for {kind} {', '.join(labels)}, since the planner does not use "
            f"the {kind} in this task"
        )
    for part in condition.unreproducible:
        remarks.append(f"Not reproducible: {part} is an object of one process")
    notes: dict[str, Any] = {"follows": planner.follows(task), "remarks": remarks}
    if condition.unreproducible:
        notes["unreproducible"] = condition.unreproducible
    notes["changed"] = changed_options(condition.planner)
    return notes


def changed_options(planner: Part) -> list[str]:
    """Return the options that differ from their defaults, as dotted `name = value`."""
    options = registry.options_of("planner", planner.found.target)
    required = {}
    for name, option in options.items():
        if option.default is NO_DEFAULT:
            required[name] = planner.options[name]
    default = registry.complete("planner", replace(planner, options=required))
    changed = differences(default.options, planner.options)
    return [f"{name} = {now}" for name, _, now in changed]
