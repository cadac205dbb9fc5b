"""Requests of a command, and the `run.json` that a run starts or is extended with."""

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
from benchnav.eval.experiment.metrics import add_metric, metrics_of_run
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
    """A checked suite with the further options of a command.

    Args:
        suite: the suite as it was written, for `run.json`.
        record: what is stored of episodes in addition to rows.
        settings: settings of units.
        shard: shard of the units that is run; None for all.
        reuse_code: whether to accept finished units of other code.
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

    Returns:
        The requested conditions, all conditions of the run, and the run's metrics in
        addition to the built-in ones.

    Raises:
        ConfigError: If the folder contains something else, or a run that cannot be
            extended by this one.
    """
    if not (folder / RUN).exists():
        if is_taken(folder):
            raise ConfigError(
                f"Expected `out` to be a new folder or a run folder, got {folder}, "
                "which holds something else. Choose "
                "another `out`."
            )
        write_run(folder, _about({}, work, work.conditions))
        return (
            work.conditions,
            work.conditions,
            tuple(metric.part for metric in work.metrics),
        )
    earlier = open_run(folder)
    _check_extends(work, earlier)
    metrics = list(metrics_of_run(earlier.about))
    n_metrics = len(metrics)
    for metric in work.metrics:
        metrics = add_metric(metrics, metric)
    work = replace(work, metrics=tuple(metrics))
    if new_names := [metric.quantity.name for metric in metrics[n_metrics:]]:
        say(
            f"{folder} is extended by "
            f"{'metric' if len(new_names) == 1 else 'metrics'} {', '.join(new_names)}"
        )
        (folder / EPISODES).unlink(missing_ok=True)
    conditions = dict(earlier.conditions)
    requested = {}
    # What differs from an earlier condition only in what is not used is run as that
    # one.
    rows_ids = {
        condition.rows_id: name for name, (condition, _) in reversed(conditions.items())
    }
    for condition_id, (condition, extent) in work.conditions.items():
        name = (
            condition_id
            if condition_id in conditions
            else rows_ids.get(condition.rows_id, condition_id)
        )
        earlier_condition, earlier_extent = conditions.get(name, (condition, extent))
        merged = merge(
            condition if condition.id == name else earlier_condition,
            (earlier_condition, condition),
        )
        requested[name] = merged, extent
        conditions[name] = merged, earlier_extent.union(extent)
    if conditions != earlier.conditions:
        new = len(conditions.keys() - earlier.conditions.keys())
        more = {0: "by more episodes", 1: "by 1 new condition"}.get(
            new, f"by {new} new conditions"
        )
        say(f"{folder} is extended {more}")
        # The table is written again when all requested units are finished.
        (folder / EPISODES).unlink(missing_ok=True)
    now = _about(earlier.about, work, conditions)
    if now != earlier.about:
        write_run(folder, now)
    return requested, conditions, tuple(metric.part for metric in metrics)


def drop(folder: Path) -> None:
    """Empty a run folder, but keep the folder itself.

    It may be a link, another file system or the working folder.
    """
    if is_taken(folder):
        open_run(folder)  # Only a run folder may be emptied.
        target = folder.resolve()
        prefix = f".{target.name}.dropped-"
        with TemporaryDirectory(dir=target.parent, prefix=prefix) as dropped:
            # `run.json` last, so that an interrupted call can be repeated.
            for path in sorted(target.iterdir(), key=lambda path: path.name == RUN):
                os.replace(path, Path(dropped, path.name))


def _check_extends(work: Work, earlier: Run) -> None:
    folder = earlier.folder
    if earlier.shard != work.shard:
        raise ConfigError(
            f"Expected `out` to be new or to hold {_in_words(work.shard)}, got "
            f"{folder}, which holds "
            f"{_in_words(earlier.shard)}. Choose another `out`."
        )
    check_resumable(earlier)
    # Other hypotheses would be written after the results that they are tested on.
    fixed = earlier.about.get("hypotheses", {}).get("digest", "none")
    if work.hypotheses and work.hypotheses["digest"] != fixed:
        raise ConfigError(
            f"Expected the `hypotheses` that were fixed when {folder} was begun "
            f"(digest {fixed}), got others (digest "
            f"{work.hypotheses['digest']}). Leave `hypotheses` out to go on, or "
            "choose another `out`."
        )
    check_labels(
        condition
        for conditions_of in (earlier, work)
        for condition, _ in conditions_of.conditions.values()
    )


def check_resumable(run: Run) -> None:
    """Reject a run whose parts were objects of a process.

    Raises:
        ConfigError: If it has such parts.
    """
    parts = [
        part
        for entry in run.about["conditions"].values()
        for part in entry.get("unreproducible", ())
    ]
    parts += [
        f"metric {entry['quantity']['name']}"
        for entry in run.about.get("metrics", ())
        if "unreproducible" in entry
    ]
    if parts:
        raise ConfigError(
            f"Expected a run that can be run again, got {run.folder}, whose "
            f"{parts[0]} was an object of one process. "
            "Evaluate it into a new folder."
        )


def _in_words(shard: Shard | None) -> str:
    return "a whole run" if shard is None else f"shard {shard} of a run"


def _about(
    earlier: Mapping[str, Any], work: Work, conditions: Conditions
) -> dict[str, Any]:
    """Return the contents of `run.json`, from an earlier state of it."""
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
    metrics = [metric.entry for metric in work.metrics]
    manifest = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **({"shard": asdict(work.shard)} if work.shard else {}),
        "suite": dict(work.suite),
        **({"hypotheses": hypotheses} if hypotheses else {}),
        **({"metrics": metrics} if metrics else {}),
        "conditions": entries,
        "dropped": _still_dropped(dropped, conditions),
        "warnings": provenance.join(earlier.get("warnings", ()), work.warnings),
        **asdict(work.settings),
        "gpu": gpu_name(work.settings.device),
        "datasets": provenance.describe_datasets(conditions),
        "machine": provenance.describe_machine(),
        "history": provenance.extend_history(earlier.get("history", ()), work.suite),
        **{
            name: earlier[name]
            for name in ("codes", "reused", "tables")
            if name in earlier
        },
    }
    return json.loads(json.dumps(manifest))


def _still_dropped(
    dropped: Iterable[dict[str, str]], conditions: Conditions
) -> list[dict[str, str]]:
    """Return the combinations left out that are in no condition, each once.

    A combination may have become a condition after a change of its parts.
    """
    condition_labels = [
        set(condition.labels.items()) for condition, _ in conditions.values()
    ]
    return provenance.join(
        entry
        for entry in dropped
        if not any(
            set(dropped_labels(entry).items()) <= labels for labels in condition_labels
        )
    )


def _notes(condition: Condition) -> dict[str, Any]:
    """Return what tables say about a condition's planner."""
    planner = condition.planner.object
    task = condition.task
    merged_notes = [
        f"One row for {kind} {', '.join(labels)}, which the planner does not use here"
        for kind, labels in condition.stands_for.items()
    ]
    unreproducible = [
        f"Not reproducible: {part} is an object of one process"
        for part in condition.unreproducible
    ]
    return {
        "follows": planner.follows(task),
        "remarks": [*planner.remarks(task), *merged_notes, *unreproducible],
        **({"unreproducible": condition.unreproducible} if unreproducible else {}),
        "changed": changed_options(condition.planner),
    }


def changed_options(planner: Part) -> list[str]:
    """Return options that differ from their defaults, as `name = value` with dots."""
    options = registry.options_of("planner", planner.found.target)
    required = {
        name: planner.options[name]
        for name, option in options.items()
        if option.default is NO_DEFAULT
    }
    defaults = registry.complete("planner", replace(planner, options=required)).options
    return [
        f"{name} = {now}" for name, _, now in differences(defaults, planner.options)
    ]
