"""Merging the shards of a run into one run folder.

The merged run can be reported, resumed and extended like any other. A finished unit
is one file, which its origin identifies, so merging checks and copies these files.
"""

import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchnav.core.errors import ConfigError
from benchnav.core.store import (
    Shard,
    new_folder,
    replace_folder,
    replacing,
    sole_writer,
)
from benchnav.core.touched import differing_entries
from benchnav.eval.experiment.condition import label_words
from benchnav.eval.experiment.metrics import metrics_of_run
from benchnav.eval.experiment.unit import Unit, in_table_order, units
from benchnav.eval.folder import provenance
from benchnav.eval.folder.checksums import note_checksums
from benchnav.eval.folder.provenance import TOUCHED
from benchnav.eval.folder.run_folder import (
    ERRORS,
    RUN,
    Finished,
    Run,
    differences,
    find_units,
    finish_run,
    is_taken,
    open_run,
    unit_rows,
    write_run,
)
from benchnav.eval.folder.steps import align_steps
from benchnav.eval.run.recordings import write_ground

_MAX_NAMED = 3  # maximum number of conditions that a message names


def merge_shards(parts: Sequence[Path], folder: Path) -> Iterator[tuple[int, int]]:
    """Merge shards into one run folder, and yield (units copied, total units).

    The new folder appears at its path only when it is complete.

    Args:
        parts: run folders of shards of one run, in any order.
        folder: path of the merged run; nothing may exist there except an empty folder.

    Raises:
        ConfigError: If a part is no shard, the parts belong to different runs, or units
            are missing. In these cases, nothing is written.
    """
    with sole_writer(folder, str(folder)):
        if is_taken(folder):
            raise ConfigError(
                f"Expected `out` to be a new folder, got {folder}, which exists. Run "
                "`benchnav-eval merge OUT PART …` with a new folder as OUT."
            )
        runs = [_open_shard(part) for part in parts]
        _check_alike(runs)
        conditions = runs[0].conditions
        all_units = in_table_order(units(conditions), conditions)
        finished_units = [(unit, _find(unit, runs)) for unit in all_units]
        _check_whole(
            [unit for unit, finished_unit in finished_units if finished_unit is None],
            runs,
        )
        complete = [
            (unit, finished_unit)
            for unit, finished_unit in finished_units
            if finished_unit is not None
        ]
        _check_one_environment([finished_unit for _, finished_unit in complete])
        target = folder.resolve()
        partial = new_folder(target)
        write_run(partial, _about(runs))
        yield 0, len(all_units)
        copied = []
        for unit, finished in complete:
            path = partial / "units" / unit.condition.id / finished.path.name
            _copy(finished.path, path)
            copied.append((unit, replace(finished, path=path)))
            yield len(copied), len(all_units)
        sources = [run.folder / kind for run in runs for kind in ("steps", "playback")]
        for source in sources:
            if source.exists():
                hidden = shutil.ignore_patterns(".*")
                shutil.copytree(
                    source,
                    partial / source.name,
                    ignore=hidden,
                    copy_function=_copy,
                    dirs_exist_ok=True,
                )
        align_steps(partial, all_units)
        finish_run(partial, copied)
        note_checksums(partial, [partial / ERRORS])
        write_ground(partial)
        replace_folder(partial, target, last=RUN)


def _check_one_environment(finished_units: Sequence[Finished]) -> None:
    """Reject units that were run with different code, files or packages."""
    for earlier, now in pairwise(finished_units):
        before = earlier.metadata["code"]
        changed = provenance.code_differences(before, now.metadata["code"])
        if changed:
            raise ConfigError(
                f"Expected all shards to be run with the same code, got {earlier.path} "
                f"and {now.path}, which differ in {'; '.join(changed)}. Run the "
                "commands of the shards again with the same code."
            )
    touched: dict[str, str] = {}
    for finished_unit in finished_units:
        contents = finished_unit.metadata.get(TOUCHED, {})
        changed = differing_entries(touched, contents)
        if changed:
            raise ConfigError(
                "Expected all shards to be run with the same files, packages and "
                f"environment variables, got {finished_unit.path}, which differs from other "
                f"units in {'; '.join(changed)}. Run the commands of the shards again "
                "without changing these."
            )
        touched |= contents


def _copy(source: str | Path, target: str | Path) -> None:
    with replacing(Path(target)) as partial:
        shutil.copyfile(source, partial)


def _open_shard(part: Path) -> Run:
    run = open_run(part)
    if run.shard is None:
        raise ConfigError(
            f"Expected folders of shards, got {part}, which is not a shard. "
            "`benchnav-eval run … --shard I/N` creates shards. Leave this folder out."
        )
    return run


def _check_alike(runs: Sequence[Run]) -> None:
    """Reject shards of different runs, listing all differences."""
    if not runs:
        raise ConfigError(
            "Expected one or more folders of shards as `parts`, got none."
        )
    reasons = []
    for run in runs[1:]:
        differing = _unlike(runs[0], run)
        if differing:
            reasons.append(f"{run.folder}: {'; '.join(differing)}")
    if reasons:
        raise ConfigError(
            f"Expected shards of one run, got shards that differ from "
            f"{runs[0].folder}: {'. '.join(reasons)}. Run the same command, with the "
            "same code and data, for each shard."
        )


def _unlike(first: Run, second: Run) -> list[str]:
    """List differences of two shards' manifests that show that their runs differ."""
    lines = []
    n_first = _shard(first).of
    n_second = _shard(second).of
    if n_second != n_first:
        lines.append(f"number of shards ({n_first} to {n_second})")
    for run, reference in ((second, first), (first, second)):
        names = []
        for condition_id, (condition, _) in reference.conditions.items():
            if condition_id not in run.conditions:
                names.append(" ".join(label_words(condition.labels)))
        if names:
            listed = ", ".join(names[:_MAX_NAMED])
            if len(names) > _MAX_NAMED:
                listed += f" and {len(names) - _MAX_NAMED} more"
            lines.append(f"conditions missing in {run.folder} ({listed})")
    common = [i for i in first.conditions if i in second.conditions]
    pairs = [(first.conditions[i], second.conditions[i]) for i in common]
    if any(a.labels != b.labels for (a, _), (b, _) in pairs):
        lines.append("labels of conditions")
    if any(set(a.draws) != set(b.draws) for (_, a), (_, b) in pairs):
        lines.append("seeds, realisations or maps")
    lines += provenance.dataset_differences(
        first.manifest["datasets"], second.manifest["datasets"]
    )
    for name in ("hypotheses", "metrics"):
        if second.manifest.get(name) != first.manifest.get(name):
            lines.append(name)
    return lines


def _find(unit: Unit, runs: Sequence[Run]) -> Finished | None:
    """Find a finished unit in shards; reject shards that have different rows for it."""
    columns = {metric.quantity.column for metric in metrics_of_run(runs[0].manifest)}
    newest = []
    for run in runs:
        finished_units = find_units(run.folder, unit)
        complete = [
            finished_unit
            for finished_unit in finished_units
            if columns <= finished_unit.metrics
        ]
        newest += complete[:1]
    for finished_unit in newest:
        damage = finished_unit.damage()
        if damage:
            raise ConfigError(
                f"{finished_unit.folder} is damaged: {damage[0]}. Repeat the command "
                "of the shard, which runs the damaged unit again."
            )
    if not newest:
        return None
    first, *others = newest
    for finished_unit in others:
        cells, _ = differences(unit_rows(first), unit_rows(finished_unit))
        if len(cells):
            raise ConfigError(
                f"Expected the same rows of a unit in all shards, got {unit.name} "
                f"({unit.condition.description}), whose rows differ between "
                f"{first.path} and {finished_unit.path}. Leave one of these shards out."
            )
    return first


def _check_whole(missing: Sequence[Unit], runs: Sequence[Run]) -> None:
    """Reject an incomplete run, naming the shards that must be run."""
    if not missing:
        return
    of = _shard(runs[0]).of
    counts = Counter(unit.shard(of).index for unit in missing)
    folders = {_shard(run).index: run.folder for run in runs}
    named = []
    for index, count in sorted(counts.items()):
        noun = "unit" if count == 1 else "units"
        begun = f" in {folders[index]}" if index in folders else ""
        named.append(f"{count} {noun} of shard {index}/{of}{begun}")
    raise ConfigError(
        f"Expected all units of the run, got shards without {', '.join(named)}. Repeat "
        "the command of the run once for each shard named here, with that shard as "
        "`--shard`. Then repeat this command with the folders of all shards."
    )


def _about(runs: Sequence[Run]) -> Mapping[str, Any]:
    """Return `run.json` of the merged run.

    The result is `run.json` of the first shard, with the latencies, warnings and
    histories of all shards.
    """
    manifest = dict(runs[0].manifest)
    manifest.pop("shard", None)
    entries: dict[str, dict[str, Any]] = {}
    for condition_id in runs[0].conditions:
        entries[condition_id] = {}
        # Entries differ only in latencies, which only shards that measured them have.
        for run in reversed(runs):
            entries[condition_id] |= run.manifest["conditions"][condition_id]
    manifest["conditions"] = entries
    for name in ("warnings", "dropped", "history"):
        manifest[name] = provenance.join(*(run.manifest[name] for run in runs))
    manifest["history"] = provenance.extend_history(
        manifest["history"], manifest["suite"]
    )
    machines = provenance.join([run.manifest["machine"] for run in runs])
    if len(machines) > 1:
        described: dict[str, None] = {}
        for machine in machines:
            described[f"{machine['processor']} with {machine['cores']} cores"] = None
        names = ", ".join(described)
        line = (
            f"the shards ran on {len(machines)} machines ({names}), so that "
            "planning times do not compare planners"
        )
        manifest["warnings"] = provenance.join(manifest["warnings"], [line])
    return manifest


def _shard(run: Run) -> Shard:
    assert run.shard is not None
    return run.shard
