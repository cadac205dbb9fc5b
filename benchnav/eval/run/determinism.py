"""Whether rows are identical if repeated in fresh processes and in another order."""

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

from benchnav.core.device import find_device
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit, units
from benchnav.eval.folder.run_folder import differences, find_units, unit_rows
from benchnav.eval.run.check import Say, check_suite
from benchnav.eval.run.unit import Settings, run_unit

# Rows of a unit, and the global generators that were drawn from while it ran.
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
    and maps in reverse order, twice, and its second rows count, so that state which
    parts keep has had time to grow. If rows differ, a third process repeats the first,
    which distinguishes kept state from external input.

    Args:
        suite: the suite.
        say: receives progress, a line at a time.
        planner_limit_s: time limit of each call of a planner; 0 for none.
        device: "cpu", "cuda" or "auto".

    Returns:
        The number of conditions, and a line for each that differs: the columns and the
        cause.

    Raises:
        BenchnavError: If the suite cannot be run.
    """
    settings = Settings(
        planner_limit_s=planner_limit_s, device=find_device(device).type
    )
    checked = check_suite(suite, elsewhere=True)
    metrics = [metric.part for metric in checked.metrics]
    chosen = []
    for name, condition in checked.conditions.items():
        chosen.append(units({name: condition}, metrics=metrics)[0])
    say(
        f"checking that {len(chosen)} conditions repeat, each by its unit of "
        f"{len(chosen[0].maps)} maps"
    )
    first = _run_fresh(chosen, settings)
    backwards = [replace(unit, maps=unit.maps[::-1]) for unit in chosen[::-1]]
    second = _run_fresh([*backwards, *backwards], settings)[len(chosen) :][::-1]
    columns = [_differing(a, b) for (a, _), (b, _) in zip(first, second, strict=True)]
    third = _run_fresh(chosen, settings) if any(columns) else first
    lines = []
    for unit, names, *runs in zip(chosen, columns, first, second, third, strict=True):
        if names:
            columns_text = ", ".join(names)
            line = f"{unit.condition.description}: {columns_text} differ"
            lines.append(f"{line}; {_cause(*runs)}")
    return len(chosen), lines


def _cause(first: _Rows, second: _Rows, third: _Rows) -> str:
    """Return why rows of a unit differ between two runs; `third` repeats `first`."""
    generators = sorted({*first[1], *second[1], *third[1]})
    if generators:
        return f"a part draws from the global generator of {' and '.join(generators)}"
    if _differing(first[0], third[0]):
        return (
            "a part depends on something outside, such as a clock, entropy or the "
            "order of threads"
        )
    return (
        "a part keeps state between episodes or units, so that rows depend on what "
        "ran before"
    )


def _differing(a: pd.DataFrame, b: pd.DataFrame) -> list[str]:
    cells, missing = differences(a, b)
    columns = list(dict.fromkeys(cells.index.get_level_values(-1)))
    return [*columns, "episodes"] if len(missing) else columns


def _run_fresh(chosen: Sequence[Unit], settings: Settings) -> list[_Rows]:
    """Run units one after the other in one fresh process."""
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
    before = {name: state() for name, state in _GENERATORS.items()}
    with TemporaryDirectory() as folder:
        run_unit(replace(unit, record="none"), Path(folder), origin, settings)
        rows = unit_rows(find_units(Path(folder), unit)[0])
    drawn_from = [
        name for name, state in _GENERATORS.items() if state() != before[name]
    ]
    return rows, tuple(drawn_from)
