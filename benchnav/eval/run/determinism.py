"""Check that rows are identical if they are repeated in new processes and reordered."""

import random
from collections.abc import Callable, Sequence
from contextlib import chdir
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import torch
from joblib.externals.loky import ProcessPoolExecutor

from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit, units
from benchnav.eval.folder.run_folder import differences, find_units, unit_rows
from benchnav.eval.run.check import Say, check_suite
from benchnav.eval.run.unit import Settings, run_unit

# Rows of a unit, and the global generators from which numbers were drawn while it ran.
_Rows = tuple[pd.DataFrame, tuple[str, ...]]

_GENERATORS: dict[str, Callable[[], bytes]] = {
    "random": lambda: repr(random.getstate()).encode(),
    "numpy.random": lambda: repr(np.random.get_state()).encode(),  # noqa: NPY002
    "torch": lambda: torch.get_rng_state().numpy().tobytes(),
}


def check_determinism(
    suite: Suite, say: Say, planner_limit_s: float = 0.0, device: str = "cpu"
) -> tuple[int, list[str]]:
    """Run the first unit of each condition in two processes and compare the rows.

    Rows are compared bit for bit, except planning times. The second process runs units
    and maps in reverse order, twice. The rows of its second repetition are compared,
    since parts that retain state have accumulated it by then. If rows differ, a third
    process repeats the units of the first process, which distinguishes retained state
    from external input.

    Args:
        suite: suite whose conditions are checked.
        say: function that receives the progress, one line at a time.
        planner_limit_s: time limit of each call of a planner in seconds; 0 for no
            limit.
        device: "cpu", "cuda" or "auto".

    Returns:
        The number of conditions, and a line for each condition that differs, with the
        differing columns and the cause.

    Raises:
        BenchnavError: If the suite cannot be run.
    """
    settings = Settings.on(device, planner_limit_s)
    checked = check_suite(suite, uses_workers=True)
    metrics = [metric.part for metric in checked.metrics]
    chosen = []
    for name, condition in checked.conditions.items():
        first_unit, *_ = units({name: condition}, metrics=metrics)
        chosen.append(first_unit)
    say(
        f"checking that {len(chosen)} conditions repeat, each by a unit of "
        f"{len(chosen[0].maps)} maps"
    )
    first = _run_fresh(chosen, settings)
    backwards = [replace(unit, maps=unit.maps[::-1]) for unit in chosen[::-1]]
    twice = _run_fresh([*backwards, *backwards], settings)
    second = twice[len(chosen) :][::-1]
    columns = [_differing(a, b) for (a, _), (b, _) in zip(first, second, strict=True)]
    third = first
    if any(columns):
        third = _run_fresh(chosen, settings)
    lines = []
    for unit, names, *runs in zip(chosen, columns, first, second, third, strict=True):
        if names:
            description = unit.condition.description
            words = ", ".join(names)
            lines.append(f"{description}: {words} differ; {_cause(*runs)}")
    return len(chosen), lines


def _cause(first: _Rows, second: _Rows, third: _Rows) -> str:
    """Return the cause of different rows in two runs; `third` repeats `first`."""
    first_rows, first_generators = first
    _, second_generators = second
    third_rows, third_generators = third
    generators = sorted({*first_generators, *second_generators, *third_generators})
    if generators:
        return f"a part draws from the global generator of {' and '.join(generators)}"
    if _differing(first_rows, third_rows):
        return (
            "a part depends on external input, such as a clock, entropy or the order "
            "of threads"
        )
    return (
        "a part keeps state between episodes or units, so that rows depend on earlier "
        "episodes"
    )


def _differing(a: pd.DataFrame, b: pd.DataFrame) -> list[str]:
    """Return the columns in which rows differ, and `episodes` if some are missing."""
    cells, missing = differences(a, b)
    columns = list(dict.fromkeys(cells.index.get_level_values(-1)))
    if len(missing):
        columns.append("episodes")
    return columns


def _run_fresh(chosen: Sequence[Unit], settings: Settings) -> list[_Rows]:
    """Run units one after the other in one new process."""
    with ProcessPoolExecutor(1) as executor:
        call = partial(_run_units, Path.cwd(), chosen, settings)
        return executor.submit(call).result()


def _run_units(
    working_folder: Path, chosen: Sequence[Unit], settings: Settings
) -> list[_Rows]:
    with chdir(working_folder):
        return [_run_unit(unit, settings) for unit in chosen]


def _run_unit(unit: Unit, settings: Settings) -> _Rows:
    origin = settings.origins().of(unit)
    states = {name: state() for name, state in _GENERATORS.items()}
    with TemporaryDirectory() as name:
        folder = Path(name)
        run_unit(replace(unit, record="none"), folder, origin, settings)
        finished, *_ = find_units(folder, unit)
        rows = unit_rows(finished)
    changed = [name for name, state in _GENERATORS.items() if state() != states[name]]
    return rows, tuple(changed)
