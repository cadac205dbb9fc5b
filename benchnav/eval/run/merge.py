"""Merging the shards of a run into one run folder, which then is as any: reported, resumed, extended."""

import os
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard, replacing, sole_writer
from benchnav.eval.experiment.keep import Keep
from benchnav.eval.experiment.unit import Unit, in_table_order, units
from benchnav.eval.folder import provenance
from benchnav.eval.folder.folder import (
    RUN,
    Run,
    about_unit,
    copy_unit,
    finish_run,
    open_run,
    unit_rows,
    write_run,
)
from benchnav.eval.folder.sameness import differences
from benchnav.eval.folder.steps import align_steps
from benchnav.eval.run.driven_ground import keep_ground

_NOT_OF_UNITS = ("units", "figures")


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
        _check_new(folder)
        runs = [_open_shard(part) for part in parts]
        of = _check_alike(runs)
        conditions = runs[0].conditions
        # What is recorded is in the folders of the shards already.
        every = in_table_order(units(conditions, Keep()), conditions)
        found = [(unit, _find(unit, runs)) for unit in every]
        _check_whole([unit for unit, run in found if run is None], runs, of)
        target = folder.resolve()
        partial = target.with_name(f".{target.name}.partial")
        if partial.exists():
            shutil.rmtree(partial)
        about = _about(runs)
        write_run(partial, about)
        yield 0, len(every)
        for done, (unit, run) in enumerate(found, start=1):
            assert run is not None
            copy_unit(run.folder, unit, partial, about["run_id"])
            yield done, len(every)
        for run in runs:
            _copy_rest(run.folder, partial)
        align_steps(partial, every)
        finish_run(partial, every)
        keep_ground(partial)
        _take_place(partial, target)


def _take_place(partial: Path, target: Path) -> None:
    """Gives a whole run its name; an empty folder that is there is filled, since it may be the one the user is in."""
    if not target.exists():
        os.replace(partial, target)
        return
    # `run.json` last, which makes it a run.
    for path in sorted(partial.iterdir(), key=lambda path: path.name == RUN):
        os.replace(path, target / path.name)
    partial.rmdir()


def _check_new(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(
            f"Expected `out` to be a new folder, got {folder}, which is there. Write `benchnav-eval merge OUT PART "
            "…`, with the new folder first."
        )


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
        unlike = _unlike_conditions(first, run) + provenance.differences(first.about, run.about)
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


def _find(unit: Unit, runs: Sequence[Run]) -> Run | None:
    """Tells which run has finished a unit; refuses one that came out differently in two."""
    holders = [run for run in runs if about_unit(run.folder, unit, run.about["run_id"]) is not None]
    for other in holders[1:]:
        if differences(unit_rows(holders[0].folder, unit), unit_rows(other.folder, unit)):
            raise ConfigError(
                f"Expected the same rows wherever a unit is, but {unit.path} ({_name(unit.condition)}) differs between "
                f"{holders[0].folder} and {other.folder}. Leave one of them out."
            )
    return holders[0] if holders else None


def _check_whole(missing: Sequence[Unit], runs: Sequence[Run], of: int) -> None:
    """Refuses a run that is not whole, and says which shards are to be run."""
    if not missing:
        return
    counts: dict[int, int] = {}
    for unit in missing:
        index = unit.share(of).index
        counts[index] = counts.get(index, 0) + 1
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
    given = {"run_id": secrets.token_hex(8), "conditions": conditions, "commands": commands}
    return {**about, **given, **joined, "history": history}


def _copy_rest(part: Path, folder: Path) -> None:
    """Copies what units wrote beside their rows, such as recordings."""
    for path in sorted(part.glob("*/**/*")):
        place = path.relative_to(part)
        hidden = any(name.startswith(".") for name in place.parts)
        if path.is_file() and not hidden and place.parts[0] not in _NOT_OF_UNITS:
            with replacing(folder / place) as partial:
                shutil.copyfile(path, partial)


def _shard(run: Run) -> Shard:
    assert run.shard is not None
    return run.shard
