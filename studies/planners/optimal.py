"""Error of the optimal planners due to their grid and dwell time; faster planners.

Planners are given the λ fields (`clairvoyant`), drawn without rejection on maps of
`stakes-v1 --seed 1`. There are three tables:

1. The time from start to goal compared with that at twice the resolution, and whether
   both find a path.
2. The added time if entering immobilising terrain counts as failure (`levels: 0`).
3. The times of other planners on the same fields, which immobilise no robot. The last
   column counts planners that beat the optimal one by more than the difference from twice
   the resolution on that map.
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
    problem: Problem, name: str, **options: Any
) -> tuple[np.ndarray, float]:
    """Return times from start to goal [B], and the computing time per map in seconds.

    The time to the goal is infinite if there is no path.
    """
    planner = make("planner", read_part("planner", {"part": name, "options": options}))
    started = time.perf_counter()
    state = Optimal.init(planner, problem, rng.generator(0))  # value iteration only
    elapsed_s = time.perf_counter() - started
    cost = (
        primitives_from(problem.start, state.dwell_s, state)
        .cost.min(1)
        .values.double()
        .numpy()
    )
    return np.where(
        cost < planner.no_path_cost(state.costs).double().numpy(), cost, np.inf
    ), elapsed_s / len(problem)


def more_time(times: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return relative increases in time, of maps on which both have a path."""
    has_both = np.isfinite(times) & np.isfinite(base)
    return (times[has_both] - base[has_both]) / base[has_both]


def grid_table(problem: Problem) -> tuple[Rows, list[tuple[np.ndarray, np.ndarray]]]:
    """Return differences from twice the resolution, and the times at both resolutions.

    There is one pair of times per row, each of shape [B].
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
    """Return the time that counting entry as failure adds to the reference."""
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
    """Return seconds to the goal, infinite if not reached: rows maps, columns planners."""
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
    """Return how often planners are faster than the optimal one, and by more than `gap_s`.

    Args:
        seconds: times to the goal, one row per map and one column per planner.
        gap_s: difference of the optimal planner to twice its resolution, shape [B].
    """
    optimal_s, rows = seconds["optimal"], []
    for planner in PLANNERS:
        planner_s = seconds[planner]
        has_arrived = np.isfinite(planner_s)
        rows.append(
            {
                "planner": planner,
                "arrived": f"{has_arrived.sum()} of {len(planner_s)}",
                "time over that of optimal: median": f"{1 + np.median(more_time(planner_s, optimal_s)):.3f}",
                "quicker": f"{np.mean(has_arrived & (planner_s < optimal_s)):.0%}",
                "quicker by more than the grid": f"{np.mean(has_arrived & (planner_s < optimal_s - gap_s)):.0%}",
            }
        )
    return rows


def tables(work: Work, folder: Path, maps: int = 50) -> dict[str, Rows]:
    """Return the tables of the grid, of entry as failure and of the other planners."""
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
