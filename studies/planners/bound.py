"""Tightness of the lower bound on the time to the goal, and attempts to beat it.

`gap` compares the bound with the near-optimal reference, on λ fields of the shipped
test maps in the world `stakes`. The gap is split by bounds that leave one cause out:
the excess of slopes that W is divided by; steps that reach from fast cells into slow
ones; dips into immobilising terrain. The remainder is due to turns, dwell time and the
error of the reference. `walls` draws small worlds that a wall of slow cells divides.
Some walls immobilise a robot before it has crossed them. Planners that are given λ then
try to be faster than the bound.
"""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from numpy import ndarray

from benchnav import Grid
from benchnav.core import rng
from benchnav.core.registry import make, read_part
from benchnav.eval.run.rollout import run_episodes
from benchnav.planning import (
    Endpoints,
    FreeSpace,
    Rules,
    Simulation,
    Task,
    TravelTime,
    Unicycle,
    World,
)
from benchnav.planning.free_space import Immobile
from benchnav.planning.world import lower_bound
from benchnav.planning.world.lower_bound import Mesh, Motion, lower_bound_s
from studies.study import Rows, Work
from studies.units import drive_unit, one_unit, pose_on, seconds_of, stakes_suite

DATA = Path("datasets/stakes-v1-test.h5")
REFERENCE = "near_optimal"
PLANNERS: dict[str, dict[str, Any]] = {
    "straight": {},
    "astar_dwa": {},
    REFERENCE: {},
    "cl_rrt": {},
    "mppi": {"samples": 512, "cost_to_go": "map"},
}
_BLOCK = 10  # worlds with the same wall
_LIMIT_S = 60.0


# --- the gap on shipped fields ---


@contextmanager
def without(**changes: Any) -> Iterator[None]:
    """Replace functions of the bound, which then holds for a less capable robot."""
    with ExitStack() as stack:
        for name, value in changes.items():
            stack.enter_context(
                patch.object(Mesh if name == "excess" else lower_bound, name, value)
            )
        yield


def no_reach(fine: ndarray, squares: Grid, step_m: float, error_m: float) -> ndarray:
    """Return λ⁺ of a robot that reads λ continuously along a step."""
    return fine


def gap(work: Work, folder: Path, maps: int = 50) -> dict[str, Rows]:
    """Return the gap between bound and reference, as fractions of its time, by cause."""
    suite = stakes_suite(
        DATA, planners=(REFERENCE,), models=("clairvoyant",), risks=("mean",)
    )
    times_s, built = drive_unit(one_unit(suite, maps))
    problem, field = built.problem, built.simulation.field
    assert field is not None
    motion = Motion(
        robot=problem.robot,
        goal_radius_m=problem.goal_radius_m,
        immobile=problem.immobile,
    )
    fractions_by_field, seconds = [], 0.0
    for index in np.flatnonzero(np.isfinite(times_s)):
        ends = problem.start[index, :2].numpy(), problem.goal_m[index].numpy()
        arguments = field[index].numpy(), problem.grid, motion, *ends
        started = time.process_time()
        bound_s = lower_bound_s(*arguments)
        seconds += time.process_time() - started
        with without(
            excess=lambda mesh, value: 1.0, _CHECK_EVERY=lower_bound._MAX_STEPS
        ):
            converged_s = lower_bound_s(*arguments)
        with without(_max_reaching=no_reach):
            without_reach_s = lower_bound_s(*arguments)
        with without(
            _max_reaching=no_reach, _max_depth_m=lambda motion, immobile: -1.0
        ):
            without_dips_s = lower_bound_s(*arguments)
        reference_s = times_s[index]
        steps = (
            bound_s,
            converged_s,
            max(converged_s, without_reach_s),
            min(max(without_reach_s, without_dips_s), reference_s),
            reference_s,
        )
        fractions_by_field.append(np.diff(steps) / reference_s)
    parts = np.array(fractions_by_field)
    names = (
        "slopes in excess",
        "steps reach into slow cells",
        "dips into immobilising terrain",
        "turns, and the reference",
        "all",
    )
    print(f"{len(parts)} fields, {seconds / len(parts):.1f} CPU-s each")
    rows = [
        {
            "cause": name,
            "median": f"{np.median(fractions):.1%}",
            "90th percentile": f"{np.quantile(fractions, 0.9):.1%}",
        }
        for name, fractions in zip(names, (*parts.T, parts.sum(1)), strict=True)
    ]
    return {"gap": rows}


# --- planners in worlds with walls ---


def walled(
    generator: np.random.Generator, grid: Grid, count: int
) -> tuple[ndarray, Immobile]:
    """Draw λ fields with a wall, and the rule of immobilisation, for `count` worlds.

    Crossing the wall takes 0.5 to 1.2 of the time that immobilises a robot. Some walls
    have gaps.
    """
    fields = generator.choice([0.6, 0.8, 0.95], (count, *grid.shape))
    thickness, slow = int(generator.integers(1, 5)), float(generator.uniform(0.1, 0.9))
    first = int(generator.integers(6, grid.width - 10))
    fields[:, :, first : first + thickness] = slow
    holes = generator.random(fields.shape) < generator.choice([0.0, 0.02, 0.1])
    fields[holes] = 0.95
    crossing_s = thickness * grid.resolution_m / slow
    immobile = Immobile(
        below=min(1.0, slow * 1.05),
        for_s=crossing_s / float(generator.uniform(0.5, 1.2)),
    )
    return fields, immobile


def drive_worlds(fields: ndarray, immobile: Immobile, grid: Grid, name: str) -> ndarray:
    """Return seconds to the goal of a planner that is given λ, shape [B].

    The time is infinite if the robot does not reach the goal.
    """
    ground, robot = torch.from_numpy(fields).float(), Unicycle()
    rules = Rules(free_space=FreeSpace(by="mean", above=0.05), min_traversability=0.02)
    task = Task(
        robot=robot, objective=TravelTime(robot, rules.goal_radius_m), rules=rules
    )
    start_m, goal_m = (
        torch.from_numpy(end).float().repeat(len(ground), 1) for end in ends_of(grid)
    )
    problem, terrain = pose_on(
        ground, grid, (start_m, goal_m), task, _LIMIT_S, immobile=immobile
    )
    places = Endpoints(
        start_m=start_m,
        goal_m=goal_m,
        reference_time_s=torch.full((len(ground),), torch.nan),
    )
    world = World(noise="stored", immobile=immobile, time_budget_s=_LIMIT_S)
    simulation = Simulation(terrain, task, world, places, 1, range(len(ground)))
    planner = make(
        "planner", read_part("planner", {"part": name, "options": PLANNERS[name]})
    )
    return seconds_of(
        run_episodes(planner, problem, simulation, rng.generator(0)), robot.dt_s
    )


def ends_of(grid: Grid) -> tuple[ndarray, ndarray]:
    """Return start and goal in metres, on opposite sides of the wall."""
    middle = grid.height // 2 * grid.resolution_m + 0.25
    return np.array([1.25, middle]), np.array([grid.extent_m[0] - 1.75, middle])


def walls(work: Work, folder: Path, maps: int = 500) -> dict[str, Rows]:
    """Return how often planners are faster than the bound in worlds with walls.

    A planner that reaches the goal although the bound is infinite is counted apart.
    """
    grid, generator = Grid(13, 26, 0.5), np.random.default_rng(0)
    blocks = [walled(generator, grid, _BLOCK) for _ in range(max(1, maps // _BLOCK))]
    bounds = []
    for fields, immobile in blocks:
        motion = Motion(
            robot=Unicycle(), goal_radius_m=Rules().goal_radius_m, immobile=immobile
        )
        bounds += [
            lower_bound_s(field, grid, motion, *ends_of(grid)) for field in fields
        ]
    bound_s = np.array(bounds)
    print(f"{len(bound_s)} worlds; in {np.isinf(bound_s).sum()} the bound is infinite")
    rows = []
    for name in PLANNERS:
        times = np.concatenate([drive_worlds(*block, grid, name) for block in blocks])
        has_arrived = np.isfinite(times)
        has_both = has_arrived & np.isfinite(bound_s)
        rows.append(
            {
                "planner, given λ": name,
                "arrived": has_arrived.sum(),
                "earlier than the bound": (times[has_both] < bound_s[has_both]).sum(),
                "where it is infinite": (has_arrived & np.isinf(bound_s)).sum(),
                "bound over its time: median": f"{np.median(bound_s[has_both] / times[has_both]):.3f}",
            }
        )
    return {"walls": rows}
