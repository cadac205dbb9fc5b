"""What a command asks of a run, and the `run.json` that a run begins with or is
extended by.
"""

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
    """What a command asks of a run, beside what of a suite is to be run.

    Args:
        suite: as it was written, for `run.json`.
        record: what is kept of episodes beside their rows.
        settings: how units are run.
        shard: which shard of the units is run; None for all.
        reuse_code: whether finished units of other code count.
    """

    suite: Mapping[str, Any]
    record: Record
    settings: Settings
    shard: Shard | None = None
    reuse_code: bool = False


def begin(
    work: Work, folder: Path, say: Say
) -> tuple[Conditions, Conditions, tuple[Part, ...]]:
    """Writes `run.json`, or extends the one that is there.

    Returns:
        What the command asks for, all conditions of the run, and the metrics that its
        rows have besides those that every run has.

    Raises:
        ConfigError: the folder holds something else, or a run that this one cannot
            extend.
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
    conditions, asked = dict(earlier.conditions), {}
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
        known, known_extent = conditions.get(name, (condition, extent))
        merged = merge(condition if condition.id == name else known, (known, condition))
        asked[name] = merged, extent
        conditions[name] = merged, known_extent.union(extent)
    if conditions != earlier.conditions:
        new = len(conditions.keys() - earlier.conditions.keys())
        more = {0: "by more episodes", 1: "by 1 new condition"}.get(
            new, f"by {new} new conditions"
        )
        say(f"{folder} is extended {more}")
        # until all that is asked for is there
        (folder / EPISODES).unlink(missing_ok=True)
    now = _about(earlier.about, work, conditions)
    if now != earlier.about:
        write_run(folder, now)
    return asked, conditions, tuple(metric.part for metric in metrics)


def drop(folder: Path) -> None:
    """Empties a run folder, which stays what it is: a link, another file system, the
    folder that the user is in.
    """
    if is_taken(folder):
        open_run(folder)  # Only what is a run folder may be dropped.
        place = folder.resolve()
        with TemporaryDirectory(
            dir=place.parent, prefix=f".{place.name}.dropped-"
        ) as dropped:
            # `run.json` last, so that a kill leaves a run that can be dropped or gone
            # on with.
            for path in sorted(place.iterdir(), key=lambda path: path.name == RUN):
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
    # Others would be written after what they are tested by.
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
        for known in (earlier, work)
        for condition, _ in known.conditions.values()
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
    """What `run.json` is to hold, of which the folder may hold an earlier state."""
    known = earlier.get("conditions", {})
    entries = {
        condition_id: {
            **{
                "value": condition.value,
                "labels": condition.labels,
                **_notes(condition),
            },
            **({"stands_for": condition.stands_for} if condition.stands_for else {}),
            **{"seeds": extent.seeds, "draws": extent.draws},
            **{
                name: value
                for name, value in known.get(condition_id, {}).items()
                if name == "latency"
            },
        }
        for condition_id, (condition, extent) in conditions.items()
    }
    about = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **({"shard": asdict(work.shard)} if work.shard else {}),
        "suite": dict(work.suite),
        **(
            {"hypotheses": fixed}
            if (fixed := earlier.get("hypotheses", work.hypotheses))
            else {}
        ),
        **(
            {"metrics": [metric.about for metric in work.metrics]}
            if work.metrics
            else {}
        ),
        "conditions": entries,
        "dropped": _still_dropped(
            [*earlier.get("dropped", ()), *work.dropped], conditions
        ),
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
    return json.loads(json.dumps(about))


def _still_dropped(
    dropped: Iterable[dict[str, str]], conditions: Conditions
) -> list[dict[str, str]]:
    """What was left out and is in no condition, as its parts may have been changed
    since; each once.
    """
    known = [set(condition.labels.items()) for condition, _ in conditions.values()]
    return provenance.join(
        entry
        for entry in dropped
        if not any(set(dropped_labels(entry).items()) <= labels for labels in known)
    )


def _notes(condition: Condition) -> dict[str, Any]:
    """What tables say of a condition's planner."""
    planner = condition.planner.object
    task = condition.task
    merged = [
        f"One row for {kind} {', '.join(labels)}, which the planner does not use here"
        for kind, labels in condition.stands_for.items()
    ]
    unreproducible = [
        f"Not reproducible: {part} is an object of one process"
        for part in condition.unreproducible
    ]
    return {
        "follows": planner.follows(task),
        "remarks": [*planner.remarks(task), *merged, *unreproducible],
        **({"unreproducible": condition.unreproducible} if unreproducible else {}),
        "changed": changed_options(condition.planner),
    }


def changed_options(planner: Part) -> list[str]:
    """Options of a planner that differ from their defaults, as `name = value`, nested
    ones with dots.
    """
    options = registry.options_of("planner", planner.found.target)
    required = {
        n: planner.options[n]
        for n, option in options.items()
        if option.default is NO_DEFAULT
    }
    defaults = registry.complete("planner", replace(planner, options=required)).options
    return [
        f"{name} = {now}" for name, _, now in differences(defaults, planner.options)
    ]
