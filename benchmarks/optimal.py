"""How near to the best the optimal planners are: their grid, dwell time, and whether another planner is quicker.

    python benchmarks/optimal.py --maps_in datasets

On λ fields of maps of `stakes-v1 --seed 1`, as the law draws them, which are given to the planners as they are
(`clairvoyant`). The first table compares the time from start to goal with that at twice the resolution, and tells
whether both find a way; then how much more it is where immobilising ground counts as loss at once
(`levels: 0`). The second drives the other planners on the same fields, which hold nobody: a planner is quicker where it
takes less than the optimal planner by more than the difference to twice the resolution on that map.
"""

import argparse
import os
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchnav.core import rng
from benchnav.core.registry import make, read_part
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent, Unit, units
from benchnav.eval.run.unit import Built, Settings, build, one_thread, simulate
from benchnav.planning.free_space import Immobile
from benchnav.planning.planners.optimal.optimal import Optimal
from benchnav.planning.planners.optimal.ways import ways_from
from benchnav.planning.problem import Problem
from benchnav.planning.world.outcome import Outcome

LAW = {"preset": "stakes", "immobile": None}
TASK = {"min_traversability": 0.01}
HOLDS = Immobile(below=0.1, for_s=2.0)
PLANNERS = ("astar_dwa", "astar_mppi", "cl_rrt", "mppi")


def unit_of(
    data: Path, planner: str, maps: int, world: Mapping[str, Any] = LAW, task: Mapping[str, Any] = TASK
) -> Unit:
    """Episodes of a planner that is given λ."""
    suite = Suite(
        data=str(data), planners=(planner,), models=("clairvoyant",), risks=("mean",), objectives=("travel_time",),
        scenarios=("std",), record="none", world=(world,), task=(task,), seeds=(1,),
    )  # fmt: skip
    condition = next(iter(conditions_of(suite, lambda data: ["std"])))
    (unit,) = units({condition.id: (condition, Extent.product((1,), 1, maps))})
    return unit


def cost_from_start(problem: Problem, planner: str, **options: Any) -> tuple[np.ndarray, float]:
    """Time from start to goal, infinite where there is no way, shape [B], and seconds of a map."""
    made = make("planner", read_part("planner", {"part": planner, "options": options}))
    begun = time.perf_counter()
    state = Optimal.init(made, problem, rng.generator(0))  # value iteration only
    took = time.perf_counter() - begun
    cost = ways_from(problem.start, state.held, state).cost.min(1).values.double().numpy()
    return np.where(cost < made.no_way(state.costs).double().numpy(), cost, np.inf), took / len(problem)


def grid_table(problem: Problem) -> tuple[Table, list[tuple[np.ndarray, np.ndarray]]]:
    """Differences to twice the resolution, and of each row the times at both, each of shape [B]."""
    table = Table(
        "planner", "more than at twice the resolution: median", "|difference|: median", "90th percentile",
        "a way is found or not: agrees", "s a map", "at twice the resolution",
    )  # fmt: skip
    held, gaps = replace(problem, immobile=HOLDS), []
    rows: tuple[tuple[str, Problem, dict[str, Any]], ...] = (
        ("optimal", problem, {}),
        ("near_optimal", held, {}),
        ("near_optimal", held, {"levels": 0}),
    )
    for name, posed, options in rows:
        coarse, took = cost_from_start(posed, name, **options)
        fine, longer = cost_from_start(posed, name, refine=2, headings=64, **options)
        both = np.isfinite(coarse) & np.isfinite(fine)
        share = (coarse[both] - fine[both]) / fine[both]
        agrees = np.mean(np.isfinite(coarse) == np.isfinite(fine))
        label = name + (", levels 0" if options else "")
        table.add_row(
            label, f"{np.median(share):+.1%}", f"{np.median(np.abs(share)):.1%}",
            f"{np.quantile(np.abs(share), 0.9):.1%}", f"{agrees:.0%}", f"{took:.2f}", f"{longer:.2f}",
        )  # fmt: skip
        gaps.append((coarse, fine))
    return table, gaps


def loss_table(reference: np.ndarray, entry: np.ndarray) -> Table:
    """What counting entry as loss adds to the time of the reference."""
    both = np.isfinite(reference) & np.isfinite(entry)
    more = (entry[both] - reference[both]) / reference[both]
    table = Table("entry as loss", "more time: median", "90th percentile", "most", "ways lost")
    lost = int((np.isfinite(reference) & ~np.isfinite(entry)).sum())
    table.add_row(
        f"{len(reference)} fields",
        f"{np.median(more):.1%}",
        f"{np.quantile(more, 0.9):.1%}",
        f"{more.max():.1%}",
        f"{lost}",
    )
    return table


def drive(data: Path, planner: str, maps: int, **law: Mapping[str, Any]) -> tuple[np.ndarray, Built]:
    """Seconds to the goal, infinite where there was no arrival, shape [B]; `law` as of `unit_of`."""
    settings, unit = Settings(), unit_of(data, planner, maps, **law)
    built = build(unit, settings.origins().of(unit))
    episodes, _ = simulate(unit, built, settings)
    seconds = episodes.steps.double().numpy() * built.problem.dt_s
    return np.where(episodes.outcome.numpy() == Outcome.SUCCESS, seconds, np.inf), built


def planner_table(data: Path, maps: int, gap_s: np.ndarray) -> Table:
    """Whether planners are quicker than the optimal one, by more than its grid's difference on that map."""
    best, _ = drive(data, "optimal", maps)
    table = Table(
        "planner", "arrived", "T / T of optimal: median", "quicker at all", "quicker by more than the grid"
    )
    for planner in ("optimal", *PLANNERS):
        own = best if planner == "optimal" else drive(data, planner, maps)[0]
        both = np.isfinite(own) & np.isfinite(best)
        quicker = [float(np.mean(np.isfinite(own) & (own < best - less))) for less in (0.0, gap_s)]
        table.add_row(
            planner, f"{np.isfinite(own).sum()} of {maps}", f"{np.median(own[both] / best[both]):.3f}",
            *(f"{share:.0%}" for share in quicker),
        )  # fmt: skip
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--maps_in", type=Path, default=Path("datasets"), help="folder of the study's maps")
    parser.add_argument("--maps", type=int, default=50)
    given = parser.parse_args()
    data = (given.maps_in / "stakes-v1-seed1.h5").resolve()
    os.chdir(Path(__file__).parents[1])  # where the shipped checkpoints are
    console = Console(width=140)
    with one_thread():
        settings, unit = Settings(), unit_of(data, "optimal", given.maps)
        problem = build(unit, settings.origins().of(unit)).problem
        table, ((coarse, fine), (reference, _), (entry, _)) = grid_table(problem)
        console.print(table)
        console.print(loss_table(reference, entry))
        known = np.isfinite(coarse) & np.isfinite(fine)
        gap_s = np.abs(np.where(known, coarse, 0.0) - np.where(known, fine, 0.0))
        console.print(planner_table(data, given.maps, gap_s))


if __name__ == "__main__":
    main()
