"""Repeating a run from its provenance, and telling whether every row came out the same.

What is repeated are the conditions of `run.json`, each as often as it was run, whatever
commands they came by.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from benchnav.core.device import device_of_run
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.progress import Progress
from benchnav.core.store import sole_writer
from benchnav.eval.experiment.condition import Condition
from benchnav.eval.experiment.metrics import metrics_of_run
from benchnav.eval.experiment.unit import Unit, units
from benchnav.eval.folder import provenance
from benchnav.eval.folder.run_folder import (
    EPISODES,
    KEYS,
    RUN,
    Run,
    differences,
    differing_columns,
    find_units,
    open_run,
    read_table,
)
from benchnav.eval.run.begin import Work, check_resumable
from benchnav.eval.run.check import (
    Say,
    build_each,
    check_everywhere,
    check_split,
    find_left_out,
)
from benchnav.eval.run.runner import run_work
from benchnav.eval.run.unit import Settings

_SHOWN = 5


def rerun(
    run_folder: Path,
    folder: Path,
    jobs: int | str = 1,
    overwrite: bool = False,
    say: Say = lambda line: None,
) -> Iterator[Progress]:
    """Runs all of a finished run again, yielding its progress in units; to be iterated
    to the end.

    Args:
        run_folder: what is repeated.
        folder: where to; a rerun that is there is gone on with.
        jobs: number of worker processes, or the address of a Dask cluster's scheduler.
        overwrite: drop the run that is there.
        say: is told what a user should know, a line at a time.

    Raises:
        ConfigError: the run is not finished, or a part of it is no longer there.
    """
    run = _open(run_folder)
    check_resumable(run)
    if folder.resolve() == run_folder.resolve():
        raise ConfigError(
            "Expected `out` to be another folder than the run that is repeated, got "
            f"{folder}."
        )
    if not overwrite and (folder / RUN).exists():
        _check_repeats(run, folder)
    settings = Settings(
        planner_limit_s=run.about["planner_limit_s"],
        device=device_of_run(run.about).type,
    )
    _check_there(run)
    metrics = metrics_of_run(run.about)
    if jobs != 1 or settings.planner_limit_s:
        check_everywhere(
            (condition for condition, _ in run.conditions.values()), metrics
        )
    work = Work(
        suite=run.about["suite"],
        conditions=run.conditions,
        dropped=tuple(run.about["dropped"]),
        warnings=tuple(run.about["warnings"]),
        hypotheses=run.about.get("hypotheses", {}),
        metrics=metrics,
        record="none",
        settings=settings,
    )
    with sole_writer(folder, str(folder)):
        yield from run_work(work, folder, jobs, overwrite, say)


def compare(run_folder: Path, folder: Path) -> tuple[bool, list[str]]:
    """Compares a run with its rerun, row by row.

    Args:
        run_folder: what was repeated.
        folder: what came out.

    Returns:
        Whether every row came out the same, in all columns of either table, and all
        that is to be told.

    Raises:
        ConfigError: one of them is not finished.
    """
    run, again = _open(run_folder), open_run(folder)
    first, second = read_table(run_folder, EPISODES), read_table(folder, EPISODES)
    columns = differing_columns(first, second)
    cells, lacking = differences(first, second)
    same = not (len(cells) or len(lacking) or columns)
    lines = [f"all {len(first)} rows came out the same"] if same else []
    if len(cells) or len(lacking):
        conditions = {
            i: one
            for i, (one, _) in (*again.conditions.items(), *run.conditions.items())
        }
        lines += _verdict(conditions, len(first), cells, lacking)
    lines += [f"column {name} is in only one of the two tables" for name in columns]
    return same, [*lines, _environment(run.about, again.about)]


def _open(folder: Path) -> Run:
    run = open_run(folder)
    read_table(folder, EPISODES)
    return run


def _check_repeats(run: Run, folder: Path) -> None:
    """Refuses a run that is no rerun: one of other conditions, or with units that were
    copied from the run itself.
    """
    if set(open_run(folder).conditions) != set(run.conditions):
        raise ConfigError(
            f"Expected `out` to be new or an earlier rerun of {run.folder}, got "
            f"{folder} with other conditions. Choose "
            "another `out`."
        )
    every = units(run.conditions)
    copied = len(_makings(run.folder, every) & _makings(folder, every))
    if copied:
        raise ConfigError(
            f"Expected `out` to be new or an earlier rerun of {run.folder}, got "
            f"{folder}, where {copied} of "
            f"{len(every)} units are copies of that run's units. Choose another "
            "`out`, or pass --overwrite."
        )


def _makings(folder: Path, every: Sequence[Unit]) -> set[str]:
    """Tokens of all makings of units, which copies of them share."""
    return {
        finished.about["made"]
        for unit in every
        for finished in find_units(folder, unit)
    }


def _check_there(run: Run) -> None:
    """Refuses a run of which something is no longer there, with all that is not."""
    lacking: dict[str, None] = {}
    parts = [metric.part for metric in metrics_of_run(run.about)]
    checks: list[Callable[[], Any]] = [partial(provenance.describe_metrics, parts)]
    for condition, extent in run.conditions.values():
        checks.append(partial(check_split, condition, maps=extent.maps))
        checks.append(partial(provenance.describe_parts, condition))
    for check in checks:
        try:
            check()
        except BenchnavError as error:
            lacking[str(error)] = None
    if lacking:
        raise ConfigError(
            f"Expected all that {run.folder} was made with, got a lack: "
            f"{' '.join(lacking)}"
        )
    conditions = [condition for condition, _ in run.conditions.values()]
    for one in find_left_out(conditions).values():
        raise ConfigError(one["reason"])
    build_each(conditions, maps=1)


def _verdict(
    conditions: Mapping[str, Condition],
    rows: int,
    cells: pd.DataFrame,
    lacking: pd.Index,
) -> list[str]:
    """Which rows came out differently, the first of them with all that differs, and the
    greatest differences.
    """
    changes = [
        f"{name} {_text(a)} → {_text(b)}" for (*_, name), a, b in cells.itertuples()
    ]
    told = (
        pd.Series(changes, index=cells.index, dtype=str)
        .groupby(level=KEYS, sort=False)
        .agg(", ".join)
    )
    differing = pd.concat(
        [told, pd.Series("in only one of the two tables", index=lacking)]
    )
    counts = differing.groupby(level="condition", sort=False).size()
    lines = [
        f"{len(differing)} of {rows} rows came out differently, in {len(counts)} of "
        f"{len(conditions)} conditions:"
    ]
    lines += [
        f"  {conditions[condition].description}: {count} rows"
        for condition, count in counts.items()
    ]
    lines.append("the first of them:")
    for (condition, *place), line in differing.head(_SHOWN).items():
        where = ", ".join(
            f"{name} {value}" for name, value in zip(KEYS[1:], place, strict=True)
        )
        lines.append(f"  {conditions[condition].description}, {where}: {line}")
    numbers = cells[cells.map(lambda value: isinstance(value, float)).all(axis=1)]
    gaps = (
        (numbers["first"] - numbers["second"])
        .abs()
        .groupby(level=-1, sort=False)
        .max()
        .dropna()
    )
    if len(gaps):
        lines.append(
            "greatest differences: "
            f"{', '.join(f'{name} {gap:.3g}' for name, gap in gaps.items())}"
        )
    return lines


def _text(value: object) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _environment(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """What differs between what two runs were made by, in words."""
    codes = zip(before["codes"].values(), now["codes"].values(), strict=False)
    changed = [line for pair in codes for line in provenance.code_differences(*pair)]
    changed += provenance.dataset_differences(before["datasets"], now["datasets"])
    machines = [
        f"{about['machine']['processor']}, {about['machine']['cores']} cores"
        for about in (before, now)
    ]
    if machines[0] != machines[1]:
        changed.append(f"machine ({machines[0]} to {machines[1]})")
    if not changed:
        return "no difference between the recorded environments"
    return f"the environments differ in: {'; '.join(dict.fromkeys(changed))}"
