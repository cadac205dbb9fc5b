"""Whether rows come out the same when they are made again: in fresh processes, in
another order of units and maps.
"""

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
_Made = tuple[pd.DataFrame, tuple[str, ...]]

_GENERATORS: dict[str, Callable[[], bytes]] = {
    "random": lambda: repr(random.getstate()).encode(),
    "numpy.random": lambda: repr(np.random.get_state()).encode(),  # noqa: NPY002
    "torch": lambda: torch.get_rng_state().numpy().tobytes(),
}


def check_determinism(
    suite: Suite, say: Say, planner_limit_s: float = 0.0, device: str = "cpu"
) -> tuple[int, list[str]]:
    """Run the first unit of each condition in two processes and compare the rows bit
    for bit, but for planning times.

    The second process runs all units in the reverse order, and the maps of each, and
    does so twice: its second rows count, so that state which parts keep has had time to
    grow. If rows differ, a third process does what the first did, which distinguishes
    state that is kept from what comes from outside.

    Args:
        suite: what is to be evaluated.
        say: is told what is done, a line at a time.
        planner_limit_s: time limit of each call of a planner; 0 for none.
        device: "cpu", "cuda" or "auto".

    Returns:
        The number of conditions, and for each that differs a line with what differs and
        why.

    Raises:
        BenchnavError: If the suite cannot be run.
    """
    settings = Settings(
        planner_limit_s=planner_limit_s, device=find_device(device).type
    )
    checked = check_suite(suite, elsewhere=True)
    metrics = [metric.part for metric in checked.metrics]
    chosen = [
        units({name: known}, metrics=metrics)[0]
        for name, known in checked.conditions.items()
    ]
    say(
        f"checking that {len(chosen)} conditions repeat, each by its unit of "
        f"{len(chosen[0].maps)} maps"
    )
    first = _run_fresh(chosen, settings)
    backwards = [replace(unit, maps=unit.maps[::-1]) for unit in chosen[::-1]]
    second = _run_fresh([*backwards, *backwards], settings)[len(chosen) :][::-1]
    columns = [
        _differing(one, other)
        for (one, _), (other, _) in zip(first, second, strict=True)
    ]
    third = _run_fresh(chosen, settings) if any(columns) else first
    lines = [
        f"{unit.condition.description}: {', '.join(names)} differ; {_cause(*made)}"
        for unit, names, *made in zip(
            chosen, columns, first, second, third, strict=True
        )
        if names
    ]
    return len(chosen), lines


def _cause(one: _Made, other: _Made, again: _Made) -> str:
    """Say why rows of a unit differ between one process and another; `again` did what
    the first did.
    """
    generators = sorted({*one[1], *other[1], *again[1]})
    if generators:
        return f"a part draws from the global generator of {' and '.join(generators)}"
    if _differing(one[0], again[0]):
        return (
            "a part depends on something outside, such as a clock, entropy or the "
            "order of threads"
        )
    return (
        "a part keeps state between episodes or units, so that rows depend on "
        "what "
        "ran before"
    )


def _differing(one: pd.DataFrame, other: pd.DataFrame) -> list[str]:
    cells, missing = differences(one, other)
    return list(dict.fromkeys(cells.index.get_level_values(-1))) + (
        ["episodes"] if len(missing) else []
    )


def _run_fresh(chosen: Sequence[Unit], settings: Settings) -> list[_Made]:
    """Run units one after the other in one fresh process."""
    with ProcessPoolExecutor(1) as executor:
        return executor.submit(
            partial(_run_units, Path.cwd(), chosen, settings)
        ).result()


def _run_units(here: Path, chosen: Sequence[Unit], settings: Settings) -> list[_Made]:
    with chdir(here):
        return [_run_unit(unit, settings) for unit in chosen]


def _run_unit(unit: Unit, settings: Settings) -> _Made:
    origin = settings.origins().of(unit)
    before = {name: state() for name, state in _GENERATORS.items()}
    with TemporaryDirectory() as folder:
        run_unit(replace(unit, record="none"), Path(folder), origin, settings)
        rows = unit_rows(find_units(Path(folder), unit)[0])
    return rows, tuple(
        name for name, state in _GENERATORS.items() if state() != before[name]
    )
