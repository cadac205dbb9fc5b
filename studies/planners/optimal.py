"""Error of the optimal planners: their grid, dwell time, and whether another planner is
quicker.

On λ fields of maps of `stakes-v1 --seed 1`, drawn without rejection, which the planners
are given (`clairvoyant`). The first table compares the time from start to goal with
that at twice the resolution, and whether both find a path; the second says how much
more it is where immobilising terrain counts as loss at once (`levels: 0`). The third
drives the other planners on the same fields, which immobilise no robot: a planner is
quicker where it takes less than the optimal planner by more than the difference to
twice the resolution on that map.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchnav import evaluate
from benchnav.core import rng
from benchnav.core.registry import make, read_part
from benchnav.planning import Optimal, Problem
from benchnav.planning.free_space import Immobile
from benchnav.planning.planners.optimal.primitives import primitives_from
from studies.study import Rows, Work
from studies.units import STAKES, build_unit, one_unit, stakes_suite

# λ is given, and immobilises no robot.
GIVEN: dict[str, Any] = {
    "models": ("clairvoyant",),
    "risks": ("mean",),
    "world": {"preset": "stakes", "immobile": None},
    "task": {"min_traversability": 0.01},
}
HOLDS = Immobile(below=0.1, for_s=2.0)
PLANNERS = ("optimal", "astar_dwa", "astar_mppi", "cl_rrt", "mppi")


def cost_from_start(
    problem: Problem, planner: str, **options: Any
) -> tuple[np.ndarray, float]:
    """Return the time from start to goal, infinite if there is no path, shape [B], and
    seconds of a map.
    """
    made = make("planner", read_part("planner", {"part": planner, "options": options}))
    begun = time.perf_counter()
    state = Optimal.init(made, problem, rng.generator(0))  # value iteration only
    took = time.perf_counter() - begun
    cost = (
        primitives_from(problem.start, state.dwell_s, state)
        .cost.min(1)
        .values.double()
        .numpy()
    )
    return np.where(
        cost < made.no_path_cost(state.costs).double().numpy(), cost, np.inf
    ), took / len(problem)


def more_time(times: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return by which fraction times are longer, of maps on which both have a path."""
    both = np.isfinite(times) & np.isfinite(base)
    return (times[both] - base[both]) / base[both]


def grid_table(problem: Problem) -> tuple[Rows, list[tuple[np.ndarray, np.ndarray]]]:
    """Return differences to twice the resolution, and of each row the times at both,
    each of shape [B].
    """
    immobilising, rows, times = replace(problem, immobile=HOLDS), [], []
    cases: tuple[tuple[str, str, Problem, dict[str, Any]], ...] = (
        ("optimal", "optimal", problem, {}),
        ("near_optimal", "near_optimal", immobilising, {}),
        ("near_optimal, levels 0", "near_optimal", immobilising, {"levels": 0}),
    )
    for name, planner, posed, options in cases:
        coarse, took = cost_from_start(posed, planner, **options)
        fine, longer = cost_from_start(posed, planner, refine=2, headings=64, **options)
        more = more_time(coarse, fine)
        rows.append(
            {
                "planner": name,
                "more time than at twice the resolution: median": f"{np.median(more):+.1%}",
                "difference: median": f"{np.median(np.abs(more)):.1%}",
                "90th percentile": f"{np.quantile(np.abs(more), 0.9):.1%}",
                "a path is found or not: agrees": f"{np.mean(np.isfinite(coarse) == np.isfinite(fine)):.0%}",
                "s a map": f"{took:.2f}",
                "at twice the resolution": f"{longer:.2f}",
            }
        )
        times.append((coarse, fine))
    return rows, times


def loss_table(reference: np.ndarray, entry: np.ndarray) -> Rows:
    """Return what counting entry as loss adds to the time of the reference."""
    more = more_time(entry, reference)
    return [
        {
            "entry as loss": f"{len(reference)} fields",
            "more time: median": f"{np.median(more):.1%}",
            "90th percentile": f"{np.quantile(more, 0.9):.1%}",
            "maximum": f"{more.max():.1%}",
            "paths lost": (np.isfinite(reference) & ~np.isfinite(entry)).sum(),
        }
    ]


def drive(data: Path, maps: int) -> pd.DataFrame:
    """Return seconds to the goal, infinite if it was not reached, a row a map and a
    column a planner.
    """
    results = evaluate(
        data, planners=PLANNERS, maps=maps, verbose=False, **STAKES | GIVEN
    )
    seconds = results.episodes["total_time_s"].where(
        results.episodes["success"], np.inf
    )
    return results.episodes.assign(seconds=seconds).pivot(
        index="map", columns="planner", values="seconds"
    )


def planner_table(seconds: pd.DataFrame, gap_s: np.ndarray) -> Rows:
    """Return whether planners are quicker than the optimal one, by more than its grid's
    difference on that map.
    """
    best, rows = seconds["optimal"], []
    for planner in PLANNERS:
        own = seconds[planner]
        has_arrived = np.isfinite(own)
        rows.append(
            {
                "planner": planner,
                "arrived": f"{has_arrived.sum()} of {len(own)}",
                "time over that of optimal: median": f"{1 + np.median(more_time(own, best)):.3f}",
                "quicker": f"{np.mean(has_arrived & (own < best)):.0%}",
                "quicker by more than the grid": f"{np.mean(has_arrived & (own < best - gap_s)):.0%}",
            }
        )
    return rows


def tables(work: Work, folder: Path, maps: int = 50) -> dict[str, Rows]:
    """Return the tables of the grid, of entry as loss and of the other planners."""
    data = work.maps_in / "stakes-v1-seed1.h5"
    problem = build_unit(
        one_unit(stakes_suite(data, planners=("optimal",), **GIVEN), maps)
    ).problem
    grid, ((coarse, fine), (reference, _), (entry, _)) = grid_table(problem)
    has_both = np.isfinite(coarse) & np.isfinite(fine)
    gap_s = np.abs(np.where(has_both, coarse, 0.0) - np.where(has_both, fine, 0.0))
    return {
        "grid": grid,
        "entry": loss_table(reference, entry),
        "planners": planner_table(drive(data, maps), gap_s),
    }
