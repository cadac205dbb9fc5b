"""Error of the optimal planners: their grid, dwell time, and whether another planner is quicker.

On λ fields of maps of `stakes-v1 --seed 1`, drawn without rejection, which the planners are given (`clairvoyant`). The
first table compares the time from start to goal with that at twice the resolution, and whether both find a path; the
second says how much more it is where immobilising terrain counts as loss at once (`levels: 0`). The third drives the
other planners on the same fields, which immobilise no robot: a planner is quicker where it takes less than the optimal
planner by more than the difference to twice the resolution on that map.
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchnav.core import rng
from benchnav.core.registry import make, read_part
from benchnav.core.tables import Table
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.run.unit import Built
from benchnav.planning.free_space import Immobile
from benchnav.planning.planners.optimal.optimal import Optimal
from benchnav.planning.planners.optimal.ways import ways_from
from benchnav.planning.problem import Problem
from studies.study import Work
from studies.tables import table
from studies.units import build_unit, drive_unit, one_unit, stakes_suite

LAW = {"preset": "stakes", "immobile": None}
TASK = {"min_traversability": 0.01}
HOLDS = Immobile(below=0.1, for_s=2.0)
PLANNERS = ("astar_dwa", "astar_mppi", "cl_rrt", "mppi")


def unit_of(
    data: Path, planner: str, maps: int, world: Mapping[str, Any] = LAW, task: Mapping[str, Any] = TASK
) -> Unit:
    """Return the episodes of a planner that is given λ."""
    suite = stakes_suite(
        data, planners=(planner,), models=("clairvoyant",), risks=("mean",), world=(world,), task=(task,)
    )
    return one_unit(suite, maps)


def cost_from_start(problem: Problem, planner: str, **options: Any) -> tuple[np.ndarray, float]:
    """Time from start to goal, infinite where there is no way, shape [B], and seconds of a map."""
    made = make("planner", read_part("planner", {"part": planner, "options": options}))
    begun = time.perf_counter()
    state = Optimal.init(made, problem, rng.generator(0))  # value iteration only
    took = time.perf_counter() - begun
    cost = ways_from(problem.start, state.held, state).cost.min(1).values.double().numpy()
    return np.where(cost < made.no_way(state.costs).double().numpy(), cost, np.inf), took / len(problem)


def grid_table(problem: Problem) -> tuple[Table, list[tuple[np.ndarray, np.ndarray]]]:
    """Return differences to twice the resolution, and of each row the times at both, each of shape [B]."""
    held, rows, gaps = replace(problem, immobile=HOLDS), [], []
    cases: tuple[tuple[str, Problem, dict[str, Any]], ...] = (
        ("optimal", problem, {}),
        ("near_optimal", held, {}),
        ("near_optimal", held, {"levels": 0}),
    )
    for name, posed, options in cases:
        coarse, took = cost_from_start(posed, name, **options)
        fine, longer = cost_from_start(posed, name, refine=2, headings=64, **options)
        both = np.isfinite(coarse) & np.isfinite(fine)
        more = (coarse[both] - fine[both]) / fine[both]
        agrees = np.mean(np.isfinite(coarse) == np.isfinite(fine))
        rows.append((
            name + (", levels 0" if options else ""), f"{np.median(more):+.1%}", f"{np.median(np.abs(more)):.1%}",
            f"{np.quantile(np.abs(more), 0.9):.1%}", f"{agrees:.0%}", f"{took:.2f}", f"{longer:.2f}",
        ))  # fmt: skip
        gaps.append((coarse, fine))
    headings = (
        "planner", "more time than at twice the resolution: median", "difference: median", "90th percentile",
        "a path is found or not: agrees", "s a map", "at twice the resolution",
    )  # fmt: skip
    return table(headings, rows), gaps


def loss_table(reference: np.ndarray, entry: np.ndarray) -> Table:
    """Return what counting entry as loss adds to the time of the reference."""
    both = np.isfinite(reference) & np.isfinite(entry)
    more = (entry[both] - reference[both]) / reference[both]
    lost = (np.isfinite(reference) & ~np.isfinite(entry)).sum()
    values = (f"{np.median(more):.1%}", f"{np.quantile(more, 0.9):.1%}", f"{more.max():.1%}", f"{lost}")
    headings = ("entry as loss", "more time: median", "90th percentile", "maximum", "paths lost")
    return table(headings, [(f"{len(reference)} fields", *values)])


def drive(data: Path, planner: str, maps: int, **law: Mapping[str, Any]) -> tuple[np.ndarray, Built]:
    """Return seconds to the goal, infinite where it was not reached, shape [B]; `law` as in `unit_of`."""
    return drive_unit(unit_of(data, planner, maps, **law))


def planner_table(data: Path, maps: int, gap_s: np.ndarray) -> Table:
    """Return whether planners are quicker than the optimal one, by more than its grid's difference on that map."""
    best, _ = drive(data, "optimal", maps)
    rows = []
    for planner in ("optimal", *PLANNERS):
        seconds = best if planner == "optimal" else drive(data, planner, maps)[0]
        both = np.isfinite(seconds) & np.isfinite(best)
        quicker = [np.mean(np.isfinite(seconds) & (seconds < best - margin)) for margin in (0.0, gap_s)]
        rows.append((
            planner, f"{np.isfinite(seconds).sum()} of {maps}", f"{np.median(seconds[both] / best[both]):.3f}",
            *(f"{fraction:.0%}" for fraction in quicker),
        ))  # fmt: skip
    headings = (
        "planner",
        "arrived",
        "time over that of optimal: median",
        "quicker",
        "quicker by more than the grid",
    )
    return table(headings, rows)


def tables(work: Work, folder: Path, maps: int = 50) -> dict[str, Table]:
    """Return the tables of the grid, of entry as loss and of the other planners."""
    data = work.maps_in / "stakes-v1-seed1.h5"
    problem = build_unit(unit_of(data, "optimal", maps)).problem
    grid, ((coarse, fine), (reference, _), (entry, _)) = grid_table(problem)
    known = np.isfinite(coarse) & np.isfinite(fine)
    gap_s = np.abs(np.where(known, coarse, 0.0) - np.where(known, fine, 0.0))
    return {"grid": grid, "entry": loss_table(reference, entry), "planners": planner_table(data, maps, gap_s)}
