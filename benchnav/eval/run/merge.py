"""Merging the shards of a run into one run folder, which then is as any: reported,
resumed, extended.

Units are files that are known by what made them, so that merging is copying them
together and checking.
"""

import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard, new_folder, replacing, sole_writer, take_place
from benchnav.core.touched import unlike
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
from benchnav.eval.run.recordings import keep_ground


def merge_shards(parts: Sequence[Path], folder: Path) -> Iterator[tuple[int, int]]:
    """Makes one run folder of shards, yielding (units copied, units in all); to be
    iterated to the end.

    The folder takes its name when it is whole.

    Args:
        parts: run folders of shards of one run, in any order.
        folder: where the run is to be; nothing, or an empty folder.

    Raises:
        ConfigError: a part is no shard, the parts are not of one run, or units are
            missing; nothing is written.
    """
    with sole_writer(folder, str(folder)):
        if is_taken(folder):
            raise ConfigError(
                f"Expected `out` to be a new folder, got {folder}, which exists. "
                "Write `benchnav-eval merge OUT PART "
                "…` with the new folder first."
            )
        runs = [_open_shard(part) for part in parts]
        _check_alike(runs)
        every = in_table_order(units(runs[0].conditions), runs[0].conditions)
        makings = [(unit, _find(unit, runs)) for unit in every]
        _check_whole([unit for unit, finished in makings if finished is None], runs)
        found = [(unit, finished) for unit, finished in makings if finished is not None]
        for (_, earlier), (_, now) in pairwise(found):
            if changed := provenance.code_differences(
                earlier.about["code"], now.about["code"]
            ):
                raise ConfigError(
                    f"Expected shards made by one code, got {earlier.path} and "
                    f"{now.path}, which differ in "
                    f"{'; '.join(changed)}. Give the commands of the shards again "
                    "with one code."
                )
        touched: dict[str, str] = {}
        for _, one in found:
            if changed := unlike(touched, one.about.get(TOUCHED, {})):
                raise ConfigError(
                    f"Expected shards whose parts read the same, got {one.path}, "
                    "which differs from units before it in "
                    f"{'; '.join(changed)}. Give the commands of the shards again "
                    "with the same files, packages and "
                    "variables."
                )
            touched |= one.about.get(TOUCHED, {})
        target = folder.resolve()
        partial = new_folder(target)
        write_run(partial, _about(runs))
        yield 0, len(every)
        copied = []
        for unit, finished in found:
            path = partial / "units" / unit.condition.id / finished.path.name
            _copy(finished.path, path)
            copied.append((unit, replace(finished, path=path)))
            yield len(copied), len(every)
        for source in [
            run.folder / kind for run in runs for kind in ("steps", "playback")
        ]:
            if source.exists():
                hidden = shutil.ignore_patterns(".*")
                shutil.copytree(
                    source,
                    partial / source.name,
                    ignore=hidden,
                    copy_function=_copy,
                    dirs_exist_ok=True,
                )
        align_steps(partial, every)
        finish_run(partial, copied)
        note_checksums(partial, [partial / ERRORS])
        keep_ground(partial)
        take_place(partial, target, last=RUN)


def _copy(source: str | Path, target: str | Path) -> None:
    with replacing(Path(target)) as partial:
        shutil.copyfile(source, partial)


def _open_shard(part: Path) -> Run:
    run = open_run(part)
    if run.shard is None:
        raise ConfigError(
            "Expected folders of shards, made with `benchnav-eval run … --shard "
            f"I/N`, got {part}, which is a whole "
            "run."
        )
    return run


def _check_alike(runs: Sequence[Run]) -> None:
    """Refuses shards of different runs, with all that differs."""
    if not runs:
        raise ConfigError("Expected one or more `parts`, folders of shards, got none.")
    reasons = [
        f"{run.folder}: {'; '.join(unlike)}"
        for run in runs[1:]
        if (unlike := _unlike(runs[0], run))
    ]
    if reasons:
        raise ConfigError(
            f"Expected shards of one run, got differences to {runs[0].folder}: "
            f"{'. '.join(reasons)}. Give the same "
            "command, with the same code and data, for each shard."
        )


def _unlike(first: Run, other: Run) -> list[str]:
    """Names what is not the same in two runs: the number of shards, conditions, how
    often they are run, and maps.
    """
    lines = []
    if _shard(other).of != _shard(first).of:
        lines.append(f"number of shards ({_shard(first).of} to {_shard(other).of})")
    for lacking, having in ((other, first), (first, other)):
        names = [
            " ".join(label_words(condition.labels))
            for i, (condition, _) in having.conditions.items()
            if i not in lacking.conditions
        ]
        if names:
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            lines.append(
                f"conditions that {lacking.folder} lacks ({', '.join(names[:3])}{more})"
            )
    both = [
        (run, other.conditions[i])
        for i, run in first.conditions.items()
        if i in other.conditions
    ]
    if any(one.labels != another.labels for (one, _), (another, _) in both):
        lines.append("labels of conditions")
    if any(set(one.draws) != set(another.draws) for (_, one), (_, another) in both):
        lines.append("seeds, realisations or maps")
    lines += provenance.dataset_differences(
        first.about["datasets"], other.about["datasets"]
    )
    lines += [
        name
        for name in ("hypotheses", "metrics")
        if other.about.get(name) != first.about.get(name)
    ]
    return lines


def _find(unit: Unit, runs: Sequence[Run]) -> Finished | None:
    """A finished unit of some runs, the newest of each; refuses one that came out
    differently in two.
    """
    columns = {one.quantity.column for one in metrics_of_run(runs[0].about)}
    found = [
        makings[0]
        for run in runs
        if (
            makings := [
                one for one in find_units(run.folder, unit) if columns <= one.metrics
            ]
        )
    ]
    for making in found:
        if damage := making.damage():
            raise ConfigError(
                f"{making.folder} is damaged: {damage[0]}. Give the shard's command "
                "again, which runs the unit again."
            )
    for other in found[1:]:
        if len(differences(unit_rows(found[0]), unit_rows(other))[0]):
            raise ConfigError(
                f"Expected the same rows of a unit in all shards, got {unit.name} "
                f"({unit.condition.description}), "
                f"which differs between {found[0].path} and {other.path}. Leave one "
                "of them out."
            )
    return found[0] if found else None


def _check_whole(missing: Sequence[Unit], runs: Sequence[Run]) -> None:
    """Refuses a run that is not whole, and says which shards are to be run."""
    if not missing:
        return
    of = _shard(runs[0]).of
    counts = Counter(unit.shard(of).index for unit in missing)
    folders = {_shard(run).index: run.folder for run in runs}
    named = []
    for index, count in sorted(counts.items()):
        begun = f" in {folders[index]}" if index in folders else ""
        named.append(
            f"{count} {'unit' if count == 1 else 'units'} of shard {index}/{of}{begun}"
        )
    raise ConfigError(
        f"Expected all units of the run, got none for: {', '.join(named)}. Finish the "
        "run's command with each of these "
        "as `--shard`, then give this command again with all parts."
    )


def _about(runs: Sequence[Run]) -> Mapping[str, Any]:
    """`run.json` of the whole: that of the first shard, with what was measured, said
    and commanded of all.
    """
    about = {name: value for name, value in runs[0].about.items() if name != "shard"}
    entries = {
        i: [run.about["conditions"][i] for run in reversed(runs)]
        for i in runs[0].conditions
    }
    # They are alike but for latencies, which only those shards have that measured them.
    about["conditions"] = {
        i: {k: v for entry in own for k, v in entry.items()}
        for i, own in entries.items()
    }
    for name in ("warnings", "dropped", "history"):
        about[name] = provenance.join(*(run.about[name] for run in runs))
    about["history"] = provenance.extend_history(about["history"], about["suite"])
    machines = provenance.join([run.about["machine"] for run in runs])
    if len(machines) > 1:
        names = ", ".join(
            dict.fromkeys(
                f"{one['processor']} with {one['cores']} cores" for one in machines
            )
        )
        line = (
            f"the shards ran on {len(machines)} machines ({names}), so that "
            "planning times do not compare planners"
        )
        about["warnings"] = provenance.join(about["warnings"], [line])
    return about


def _shard(run: Run) -> Shard:
    assert run.shard is not None
    return run.shard
