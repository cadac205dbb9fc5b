"""Repeating a run from its provenance, and telling whether every row came out the same.

What is repeated are the conditions of `run.json`, each as often as it was run, whatever commands they came by.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import pandas as pd

from benchnav.core.device import device_of_run
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.store import sole_writer
from benchnav.datagen.files.reader import TerrainDataset, find_dataset
from benchnav.eval.experiment.condition import Condition
from benchnav.eval.experiment.unit import Unit, units
from benchnav.eval.folder import provenance
from benchnav.eval.folder.folder import EPISODES, RUN, Run, find_units, open_run, read_table
from benchnav.eval.folder.sameness import KEYS, Difference, differences, differing_columns
from benchnav.eval.run.begin import Work
from benchnav.eval.run.check import Builder, Say, check_everywhere
from benchnav.eval.run.runner import run_work
from benchnav.eval.run.unit import Settings

_SHOWN = 5


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """How a run that was repeated came out.

    Args:
        episodes: how many were compared.
        different: those that are not the same.
        columns: those that only one of the two tables has.
        lines: all that is to be told.
    """

    episodes: int
    different: tuple[Difference, ...]
    columns: tuple[str, ...]
    lines: tuple[str, ...]

    @property
    def same(self) -> bool:
        """Whether every row came out the same, in all columns of either table."""
        return not self.different and not self.columns


def rerun(
    run_folder: Path,
    folder: Path,
    jobs: int = 1,
    scheduler: str = "",
    overwrite: bool = False,
    say: Say = lambda line: None,
) -> Iterator[tuple[int, int]]:
    """Runs all of a finished run again, yielding (units done, units in all); to be iterated to the end.

    Args:
        run_folder: what is repeated.
        folder: where to; a rerun that is there is gone on with.
        jobs: worker processes.
        scheduler: address of a Dask cluster's scheduler, whose workers are used in place of `jobs`.
        overwrite: drop the run that is there.
        say: is told what a user should know, a line at a time.

    Raises:
        ConfigError: the run is not finished, or a part of it is no longer there.
    """
    run = _open(run_folder)
    if folder.resolve() == run_folder.resolve():
        raise ConfigError(f"Expected `out` to be another folder than the run that is repeated, got {folder}.")
    if not overwrite:
        _check_no_copy(run, folder)
    settings = Settings(planner_limit_s=run.about["planner_limit_s"], device=device_of_run(run.about).type)
    _check_there(run)
    if not overwrite and (folder / RUN).exists() and set(open_run(folder).conditions) != set(run.conditions):
        raise ConfigError(
            f"Expected `out` to be new or an earlier rerun of {run_folder}, but {folder} has other conditions. Choose "
            "another `out`."
        )
    if jobs > 1 or scheduler or settings.planner_limit_s:
        check_everywhere(condition for condition, _ in run.conditions.values())
    work = Work(
        suite=run.about["suite"],
        conditions=run.conditions,
        dropped=tuple(run.about["dropped"]),
        warnings=tuple(run.about["warnings"]),
        hypotheses=run.about.get("hypotheses", {}),
        record="none",
        settings=settings,
    )
    with sole_writer(folder, str(folder)):
        yield from run_work(work, folder, jobs, scheduler, overwrite, say)


def compare(run_folder: Path, folder: Path) -> Comparison:
    """Compares a run with its rerun, row by row.

    Args:
        run_folder: what was repeated.
        folder: what came out.

    Raises:
        ConfigError: one of them is not finished.
    """
    run, again = _open(run_folder), open_run(folder)
    first, second = read_table(run_folder, EPISODES), read_table(folder, EPISODES)
    different, columns = differences(first, second), differing_columns(first, second)
    conditions = {i: condition for i, (condition, _) in (*again.conditions.items(), *run.conditions.items())}
    lines = [] if columns and not different else _verdict(conditions, len(first), different)
    lines += [f"only one of the two tables has the column {name}" for name in columns]
    lines += _environment(run.about, again.about)
    return Comparison(
        episodes=len(first), different=tuple(different), columns=tuple(columns), lines=tuple(lines)
    )


def _open(folder: Path) -> Run:
    run = open_run(folder)
    read_table(folder, EPISODES)
    return run


def _check_no_copy(run: Run, folder: Path) -> None:
    """Refuses a folder with units that were copied from the run: to compare a run with itself certifies nothing."""
    every = units(run.conditions) if folder.is_dir() else []
    copied = sum(bool(_makings(run.folder, unit) & _makings(folder, unit)) for unit in every)
    if copied:
        raise ConfigError(
            f"Expected `out` to be new or an earlier rerun of {run.folder}, but {copied} of the {len(every)} units in "
            f"{folder} are copies of its own, which repeat nothing. Choose another `out`, or pass --overwrite."
        )


def _makings(folder: Path, unit: Unit) -> set[str]:
    """Tokens of all makings of a unit, which copies of it share."""
    return {finished.about["made"] for finished in find_units(folder, unit)}


def _check_there(run: Run) -> None:
    """Refuses a run of which something is no longer there, with all that is not."""
    lacking: dict[str, None] = {}
    builder = Builder({}, seed=0, maps=1)
    for condition, extent in run.conditions.values():
        for check in (partial(_check_maps, extent.maps), provenance.describe_parts):
            try:
                check(condition)
            except BenchnavError as error:
                lacking[str(error)] = None
        if not lacking:
            builder.build(condition)
    if lacking:
        raise ConfigError(
            f"{run.folder} cannot be repeated here, since something is no longer there. {' '.join(lacking)}"
        )


def _check_maps(maps: int, condition: Condition) -> None:
    count = TerrainDataset(find_dataset(condition.data)).map_count(condition.split)
    if count < maps:
        raise ConfigError(f"Expected {maps} maps of {condition.data} {condition.split}, got {count}.")


def _verdict(conditions: Mapping[str, Condition], rows: int, different: list[Difference]) -> list[str]:
    if not different:
        return [f"all {rows} rows came out the same"]
    counts = Counter(difference.episode[0] for difference in different)
    lines = [
        f"{len(different)} of {rows} rows came out differently, in {len(counts)} of {len(conditions)} conditions:"
    ]
    for condition_id, count in counts.items():
        lines.append(f"  {_label(conditions[condition_id])}: {count} rows")
    lines.append("first of them:")
    for difference in islice(different, _SHOWN):
        condition_id, *place = difference.episode
        where = ", ".join(f"{name} {value}" for name, value in zip(KEYS[1:], place, strict=True))
        lines.append(f"  {_label(conditions[condition_id])}, {where}: {_by_how_much(difference)}")
    greatest = _greatest(different)
    if greatest:
        lines.append(f"greatest differences: {', '.join(greatest)}")
    return lines


def _label(condition: Condition) -> str:
    return ", ".join(f"{name} {label}" for name, label in condition.labels.items())


def _by_how_much(difference: Difference) -> str:
    if not difference.columns:
        return "in one of the tables alone"
    return ", ".join(f"{name} {_text(a)} → {_text(b)}" for name, (a, b) in difference.columns.items())


def _text(value: object) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _greatest(different: list[Difference]) -> list[str]:
    """The greatest difference of each column of numbers."""
    greatest: dict[str, float] = {}
    for difference in different:
        for name, (a, b) in difference.columns.items():
            if isinstance(a, float) and isinstance(b, float) and not pd.isna(a - b):
                greatest[name] = max(abs(a - b), greatest.get(name, 0.0))
    return [f"{name} {value:.3g}" for name, value in greatest.items()]


def _environment(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What differs between what two runs were made by, in words."""
    codes = zip(before["codes"].values(), now["codes"].values(), strict=False)
    changed = [line for pair in codes for line in provenance.code_differences(*pair)]
    changed += provenance.dataset_differences(before["datasets"], now["datasets"])
    machines = [
        f"{about['machine']['processor']}, {about['machine']['cores']} cores" for about in (before, now)
    ]
    if machines[0] != machines[1]:
        changed.append(f"machine ({machines[0]} to {machines[1]})")
    if not changed:
        return ["nothing that is known of the environment differs"]
    return [f"what differs in the environment: {'; '.join(dict.fromkeys(changed))}"]
