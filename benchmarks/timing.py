"""Common functions of benchmarks: clocks, memory, problems of shipped maps, tables."""

import resource
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import pandas as pd
import torch

from benchnav.core.tables import print_table
from benchnav.eval import Suite
from benchnav.planning import Problem, Step
from studies.runs import table_of
from studies.units import build_unit, one_unit

REPEATS = 31


def seconds(
    work: Callable[[], object],
    repeats: int,
    clock: Callable[[], float] = time.perf_counter,
) -> list[float]:
    """Return the seconds that each repeat of some work takes."""
    times = []
    for _ in range(repeats):
        start = clock()
        work()
        times.append(clock() - start)
    return times


def milliseconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the median time of some work in milliseconds, after three warm-up runs."""
    return 1e3 * median(seconds(work, 3 + repeats)[3:])


def per_second(count: int, times: list[float]) -> dict[str, float]:
    """Return the median rate per second, and its range, of `count` items per time."""
    return {
        "median": count / median(times),
        "lowest": count / max(times),
        "highest": count / min(times),
    }


def peak_gib() -> float:
    """Return the peak memory of this process in GiB."""
    # The unit is kilobytes on Linux and bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def problem_of(episodes: int) -> Problem:
    """Return the problem of the first maps of std under the true distributions of λ."""
    suite = Suite(
        data="paper-v1-test",
        scenarios=("std",),
        model="oracle",
        planners=("straight",),
        risks=("mean",),
    )
    return build_unit(one_unit(suite, episodes)).problem


def plan_ms(planner: Any, problem: Problem, repeats: int = REPEATS) -> float:
    """Return the planning time of a step, after the first, in ms per episode."""
    state = planner.init(problem, torch.Generator().manual_seed(0))
    observed = torch.full((len(problem),), torch.nan)
    step = Step(state=problem.start, traversability=observed, time_s=0.0)
    _, state, _ = planner.plan(step, state)
    return milliseconds(lambda: planner.plan(step, state), repeats) / len(problem)


def show(rows: list[dict[str, Any]]) -> None:
    """Print rows as a table."""
    print_table(table_of(pd.DataFrame(rows)))
