"""Merging the shards of a run into one run folder, which then is as any: reported, resumed, extended.

Units are files that are known by what made them, so that merging is copying them together and checking.
"""

import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard, new_folder, replacing, sole_writer, take_place
from benchnav.eval.experiment.unit import Unit, in_table_order, units
from benchnav.eval.folder import provenance
from benchnav.eval.folder.folder import (
    RUN,
    Finished,
    Run,
    find_units,
    finish_run,
    open_run,
    unit_rows,
    write_run,
)
from benchnav.eval.folder.sameness import differences
from benchnav.eval.folder.steps import align_steps
from benchnav.eval.run.again import keep_ground

_COPIED = ("units", "steps", "playback")


def merge_shards(parts: Sequence[Path], folder: Path) -> Iterator[tuple[int, int]]:
    """Makes one run folder of shards, yielding (units copied, units in all); to be iterated to the end.

    The folder takes its name when it is whole.

    Args:
        parts: run folders of shards of one run, in any order.
        folder: where the run is to be; nothing, or an empty folder.

    Raises:
        ConfigError: a part is no shard, the parts are not of one run, or units are missing; nothing is written.
    """
    with sole_writer(folder, str(folder)):
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ConfigError(
                f"Expected `out` to be a new folder, got {folder}, which is there. Write `benchnav-eval merge OUT PART "
                "…`, with the new folder first."
            )
        runs = [_open_shard(part) for part in parts]
        of = _check_alike(runs)
        every = in_table_order(units(runs[0].conditions), runs[0].conditions)
        found = [(unit, _find(unit, runs)) for unit in every]
        _check_whole([unit for unit, finished in found if finished is None], runs, of)
        _check_one_code([finished for _, finished in found if finished is not None])
        target = folder.resolve()
        partial = new_folder(target)
        write_run(partial, _about(runs))
        yield 0, len(every)
        for done, (unit, finished) in enumerate(found, start=1):
            if finished is not None:
                _copy(finished.path, partial / "units" / unit.condition.id / finished.path.name)
            yield done, len(every)
        for run in runs:
            for path in sorted(path for kind in _COPIED[1:] for path in (run.folder / kind).rglob("*")):
                if path.is_file() and not path.name.startswith("."):
                    _copy(path, partial / path.relative_to(run.folder))
        align_steps(partial, every)
        finish_run(partial, [(unit, find_units(partial, unit)[0]) for unit in every])
        keep_ground(partial)
        take_place(partial, target, last=RUN)


def _copy(source: Path, target: Path) -> None:
    with replacing(target) as partial:
        shutil.copyfile(source, partial)


def _open_shard(part: Path) -> Run:
    run = open_run(part)
    if run.shard is None:
        raise ConfigError(
            f"Expected folders of shards, made with `benchnav-eval run … --shard I/N`, got {part}, which is a whole "
            "run."
        )
    return run


def _check_alike(runs: Sequence[Run]) -> int:
    """Refuses shards of different runs, with all that differs; gives how many shards the run has."""
    if not runs:
        raise ConfigError("Expected one or more `parts`, folders of shards, got none.")
    first = runs[0]
    reasons = []
    for run in runs[1:]:
        unlike = _unlike_conditions(first, run)
        unlike += provenance.dataset_differences(first.about["datasets"], run.about["datasets"])
        if run.about.get("hypotheses") != first.about.get("hypotheses"):
            unlike.append("hypotheses")
        if _shard(run).of != _shard(first).of:
            unlike.insert(0, f"number of shards ({_shard(first).of} to {_shard(run).of})")
        if unlike:
            reasons.append(f"{run.folder}: {'; '.join(unlike)}")
    if reasons:
        raise ConfigError(
            f"Expected shards of one run, but these differ from {first.folder} in what is named: "
            f"{'. '.join(reasons)}. Give one command, of one code and data, for each of the shards."
        )
    return _shard(first).of


def _check_one_code(finished: Sequence[Finished]) -> None:
    """Refuses units of one run that different code has made, but for what was taken as such."""
    for earlier, now in pairwise(finished):
        changed = provenance.code_differences(earlier.about["code"], now.about["code"])
        if changed:
            raise ConfigError(
                f"Expected shards that one code has made, but {earlier.path} and {now.path} differ in "
                f"{'; '.join(changed)}. Give the commands of the shards again, by one code."
            )


def _unlike_conditions(first: Run, other: Run) -> list[str]:
    """Names the conditions that are not the same in two runs, or not run as often."""
    lines = []
    for lacking, having in ((other, first), (first, other)):
        names = [
            _name(condition) for i, (condition, _) in having.conditions.items() if i not in lacking.conditions
        ]
        if names:
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            lines.append(f"conditions that {lacking.folder} lacks ({', '.join(names[:3])}{more})")
    both = [i for i in first.conditions if i in other.conditions]
    if any(first.conditions[i][0].labels != other.conditions[i][0].labels for i in both):
        lines.append("labels of conditions")
    if any(set(first.conditions[i][1].draws) != set(other.conditions[i][1].draws) for i in both):
        lines.append("seeds, realisations or maps")
    return lines


def _name(condition: Any) -> str:
    return " ".join(condition.labels[name] for name in ("scenario", "world", "planner", "model", "risk"))


def _find(unit: Unit, runs: Sequence[Run]) -> Finished | None:
    """A finished unit of some runs, the newest of each; refuses one that came out differently in two."""
    found = [makings[0] for run in runs if (makings := find_units(run.folder, unit))]
    for other in found[1:]:
        if differences(unit_rows(found[0]), unit_rows(other)):
            raise ConfigError(
                f"Expected the same rows wherever a unit is, but {unit.name} ({_name(unit.condition)}) differs between "
                f"{found[0].path} and {other.path}. Leave one of them out."
            )
    return found[0] if found else None


def _check_whole(missing: Sequence[Unit], runs: Sequence[Run], of: int) -> None:
    """Refuses a run that is not whole, and says which shards are to be run."""
    if not missing:
        return
    counts = Counter(unit.shard(of).index for unit in missing)
    folders = {_shard(run).index: run.folder for run in runs}
    named = []
    for index, count in sorted(counts.items()):
        begun = f" in {folders[index]}" if index in folders else ""
        named.append(f"{count} {'unit' if count == 1 else 'units'} of shard {index}/{of}{begun}")
    raise ConfigError(
        f"Expected all units of the run, but these are missing: {', '.join(named)}. Give the run's command to its "
        "end with each of these as `--shard`, then this command again with all parts."
    )


def _about(runs: Sequence[Run]) -> Mapping[str, Any]:
    """`run.json` of the whole: that of the first shard, with what was measured, said and commanded of all."""
    about = {name: value for name, value in runs[0].about.items() if name != "shard"}
    conditions = {i: dict(entry) for i, entry in about["conditions"].items()}
    for run in runs:
        for condition_id, entry in run.about["conditions"].items():
            if "latency" in entry:
                conditions[condition_id].setdefault("latency", entry["latency"])
    joined: dict[str, list[Any]] = {
        name: provenance.join(*(run.about.get(name, ()) for run in runs))
        for name in ("warnings", "dropped", "history")
    }
    commands = provenance.command_lines(provenance.join(*(run.about["commands"] for run in runs)))
    history = provenance.extend_history(joined["history"], about["suite"])
    return {**about, **joined, "conditions": conditions, "commands": commands, "history": history}


def _shard(run: Run) -> Shard:
    assert run.shard is not None
    return run.shard
