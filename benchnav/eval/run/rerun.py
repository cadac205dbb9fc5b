"""Repetition of a run from its provenance, and comparison of all rows.

All conditions of `run.json` are repeated with their extents, including those that later
commands added.
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
)
from benchnav.eval.run.combinations import find_left_out
from benchnav.eval.run.runner import run_work
from benchnav.eval.run.unit import Settings

_MAX_SHOWN = 5  # maximum number of rows that a comparison lists


def rerun(
    run_folder: Path,
    folder: Path,
    jobs: int | str = 1,
    overwrite: bool = False,
    say: Say = lambda line: None,
) -> Iterator[Progress]:
    """Run all units of a finished run again, and yield the progress in units.

    Args:
        run_folder: the run that is repeated.
        folder: folder of the rerun; an interrupted rerun is resumed.
        jobs: number of worker processes, or the address of a Dask cluster's scheduler.
        overwrite: whether to delete a run in `folder` first.
        say: function that receives messages for the user, one line at a time.

    Raises:
        ConfigError: If the run is not finished, `folder` contains another run, or a
            part or map is missing.
    """
    run = _open(run_folder)
    check_resumable(run)
    if folder.resolve() == run_folder.resolve():
        raise ConfigError(
            "Expected `out` to differ from the folder of the original run, got "
            f"{folder}. Choose another `out`."
        )
    if not overwrite and (folder / RUN).exists():
        _check_repeats(run, folder)
    settings = Settings(
        planner_limit_s=run.manifest["planner_limit_s"],
        device=device_of_run(run.manifest).type,
    )
    _check_available(run)
    metrics = metrics_of_run(run.manifest)
    if jobs != 1 or settings.planner_limit_s:
        conditions = [condition for condition, _ in run.conditions.values()]
        check_everywhere(conditions, metrics)
    work = Work(
        suite=run.manifest["suite"],
        conditions=run.conditions,
        dropped=tuple(run.manifest["dropped"]),
        warnings=tuple(run.manifest["warnings"]),
        hypotheses=run.manifest.get("hypotheses", {}),
        metrics=metrics,
        record="none",
        settings=settings,
    )
    with sole_writer(folder, str(folder)):
        yield from run_work(work, folder, jobs, overwrite, say)


def compare(run_folder: Path, folder: Path) -> tuple[bool, list[str]]:
    """Compare a run with its rerun, row by row.

    Args:
        run_folder: the original run.
        folder: the rerun.

    Returns:
        Whether all rows and columns of both tables are identical, and lines for the
        user.

    Raises:
        ConfigError: If one of the runs is not finished.
    """
    run = _open(run_folder)
    again = open_run(folder)
    first = read_table(run_folder, EPISODES)
    second = read_table(folder, EPISODES)
    columns = differing_columns(first, second)
    cells, missing = differences(first, second)
    rows_differ = bool(len(cells) or len(missing))
    same = not rows_differ and not columns
    lines = []
    if same:
        lines.append(f"all {len(first)} rows are identical")
    if rows_differ:
        conditions: dict[str, Condition] = {}
        for entries in (again.conditions, run.conditions):
            conditions |= {i: condition for i, (condition, _) in entries.items()}
        lines += _verdict(conditions, len(first), cells, missing)
    lines += [f"column {name} is in only one of the two tables" for name in columns]
    lines.append(_environment(run.manifest, again.manifest))
    return same, lines


def _open(folder: Path) -> Run:
    """Open a finished run; reject a run without a table."""
    run = open_run(folder)
    read_table(folder, EPISODES)
    return run


def _check_repeats(run: Run, folder: Path) -> None:
    """Reject a folder with other conditions, or with copies of the run's units."""
    if set(open_run(folder).conditions) != set(run.conditions):
        raise ConfigError(
            f"Expected `out` to be new or an earlier rerun of {run.folder}, got "
            f"{folder}, which has other conditions. Choose another `out`."
        )
    run_units = units(run.conditions)
    copied = _tokens(run.folder, run_units) & _tokens(folder, run_units)
    if copied:
        raise ConfigError(
            f"Expected `out` to be new or an earlier rerun of {run.folder}, got "
            f"{folder}, where {len(copied)} of {len(run_units)} units are copies from "
            "the original run. Choose another `out`, or pass --overwrite."
        )


def _tokens(folder: Path, run_units: Sequence[Unit]) -> set[str]:
    """Return the tokens of all finished units; a copy has the token of its original."""
    tokens = set()
    for unit in run_units:
        for finished in find_units(folder, unit):
            tokens.add(finished.metadata["made"])
    return tokens


def _check_available(run: Run) -> None:
    """Reject a run with missing maps or parts, and list them all."""
    missing: dict[str, None] = {}
    parts = [metric.part for metric in metrics_of_run(run.manifest)]
    checks: list[Callable[[], Any]] = [partial(provenance.describe_metrics, parts)]
    for condition, extent in run.conditions.values():
        checks.append(partial(check_split, condition, maps=extent.maps))
        checks.append(partial(provenance.describe_parts, condition))
    for check in checks:
        try:
            check()
        except BenchnavError as error:
            missing[str(error)] = None
    if missing:
        raise ConfigError(
            f"Expected all inputs of {run.folder}, got none for some parts or maps: "
            f"{' '.join(missing)}"
        )
    conditions = [condition for condition, _ in run.conditions.values()]
    for entry in find_left_out(conditions).values():
        raise ConfigError(entry["reason"])
    build_each(conditions, maps=1)


def _verdict(
    conditions: Mapping[str, Condition],
    rows: int,
    cells: pd.DataFrame,
    missing: pd.Index,
) -> list[str]:
    """Describe the differing rows: counts, the first rows and the largest differences.

    Args:
        conditions: conditions of both runs, by id.
        rows: number of rows of the original run.
        cells: differing cells, from `differences`.
        missing: keys of rows that only one table has.
    """
    changes = [
        f"{name} {_text(a)} → {_text(b)}" for (*_, name), a, b in cells.itertuples()
    ]
    by_row = pd.Series(changes, index=cells.index, dtype=str).groupby(
        level=KEYS, sort=False
    )
    unmatched = pd.Series("in only one of the two tables", index=missing)
    differing = pd.concat([by_row.agg(", ".join), unmatched])
    counts = differing.groupby(level="condition", sort=False).size()
    lines = [
        f"{len(differing)} of {rows} rows differ, in {len(counts)} of "
        f"{len(conditions)} conditions:"
    ]
    for condition, count in counts.items():
        lines.append(f"  {conditions[condition].description}: {count} rows")
    lines.append("the first of these rows:")
    for (condition, *draw), line in differing.head(_MAX_SHOWN).items():
        keys = zip(KEYS[1:], draw, strict=True)
        words = ", ".join(f"{name} {value}" for name, value in keys)
        lines.append(f"  {conditions[condition].description}, {words}: {line}")
    is_number = cells.map(lambda value: isinstance(value, float)).all(axis=1)
    numbers = cells[is_number]
    gaps = (numbers["first"] - numbers["second"]).abs()
    max_gaps = gaps.groupby(level=-1, sort=False).max().dropna()
    if len(max_gaps):
        words = ", ".join(f"{name} {gap:.3g}" for name, gap in max_gaps.items())
        lines.append(f"largest differences: {words}")
    return lines


def _text(value: object) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _environment(
    before_manifest: Mapping[str, Any], now_manifest: Mapping[str, Any]
) -> str:
    """Describe the differences between the environments of two runs."""
    before_codes = before_manifest["codes"].values()
    now_codes = now_manifest["codes"].values()
    changed = []
    for before_code, now_code in zip(before_codes, now_codes, strict=False):
        changed += provenance.code_differences(before_code, now_code)
    changed += provenance.dataset_differences(
        before_manifest["datasets"], now_manifest["datasets"]
    )
    before_machine = _machine_words(before_manifest["machine"])
    now_machine = _machine_words(now_manifest["machine"])
    if before_machine != now_machine:
        changed.append(f"machine ({before_machine} to {now_machine})")
    if not changed:
        return "no difference between the recorded environments"
    return f"the environments differ in: {'; '.join(dict.fromkeys(changed))}"


def _machine_words(machine: Mapping[str, Any]) -> str:
    return f"{machine['processor']}, {machine['cores']} cores"
