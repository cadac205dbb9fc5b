"""Build and run one unit of a suite in this process, for scripts of studies."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchnav import Grid, Terrain, TraversabilityMixture
from benchnav.eval import Suite
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.unit import Extent, Unit, units
from benchnav.eval.run.rollout import Episodes
from benchnav.eval.run.unit import Settings, UnitInputs, build, simulate
from benchnav.planning import Prediction, Problem, Task, pose_problem
from benchnav.planning.free_space import Immobile
from benchnav.planning.world.outcome import Outcome

# Settings that all suites of scripts in the world `stakes` share.
STAKES: dict[str, Any] = {
    "objectives": ("travel_time",),
    "scenarios": ("std",),
    "record": "none",
    "world": ("stakes",),
    "seeds": (1,),
}


def stakes_suite(data: Path, **options: Any) -> Suite:
    """Return a suite with the settings of `STAKES`, which `options` may replace."""
    return Suite(data=str(data), **STAKES | options)


def one_unit(suite: Suite, maps: int) -> Unit:
    """Return the unit of a suite's first condition on its first `maps` maps."""
    condition = conditions_of(suite, lambda data: ["std"])[0]
    return units(
        {condition.id: (condition, Extent.product(suite.seeds or (0,), 1, maps))}
    )[0]


def build_unit(unit: Unit) -> UnitInputs:
    """Build the problem and the simulation of a unit."""
    return build(unit, Settings().origins().of(unit))


def pose_on(
    ground: Tensor,
    grid: Grid,
    ends_m: tuple[Tensor, Tensor],
    task: Task,
    time_budget_s: float,
    immobile: Immobile | None = None,
) -> tuple[Problem, Terrain]:
    """Return a problem on flat terrain whose λ planners are given, and the terrain.

    Args:
        ground: λ, shape [B, H, W].
        grid: grid of the maps.
        ends_m: start and goal in metres, shape [B, 2] each.
        task: task of the robots.
        time_budget_s: time limit of an episode in seconds.
        immobile: rule of immobilisation; if None, no robot is immobilised.
    """
    level, flat = ground[:, None], torch.zeros_like(ground)
    truth = TraversabilityMixture(
        torch.ones_like(level), level, torch.zeros_like(level), (0,)
    )
    rgb = torch.zeros(len(ground), 3, *grid.shape, dtype=torch.uint8)
    terrain = Terrain(
        rgb=rgb,
        class_id=flat.long(),
        elevation_m=flat,
        slope_deg=flat,
        truth=truth,
        traversability=ground,
        grid=grid,
    )
    prediction = Prediction(terrain.observe(), truth, ground)
    problem = pose_problem(task, prediction, *ends_m, time_budget_s, immobile)
    return problem, terrain


def seconds_of(episodes: Episodes, dt_s: float) -> np.ndarray:
    """Return seconds to the goal, infinite if not reached, shape [B]."""
    has_arrived = (episodes.outcome == Outcome.SUCCESS).numpy()
    return np.where(has_arrived, episodes.steps.double().numpy() * dt_s, np.inf)


def drive_unit(unit: Unit) -> tuple[np.ndarray, UnitInputs]:
    """Run a unit; return seconds to the goal [B], infinite if not reached, and the unit."""
    built = build_unit(unit)
    episodes, _ = simulate(unit, built, Settings())
    return seconds_of(episodes, built.problem.dt_s), built
