"""Time of the parts of MPPI's rollouts and of a CVaR map.

    python -m benchmarks.parts

All run on one thread. Rollouts have 5 000 samples × 50 steps, are compiled and are
timed per episode of 20. They are repeated without single parts: without headings, the
robot moves along x and y; without lookups, λ̂ of all cells is that of the first one.
Neither gives sensible motion. CVaR is of the shipped model's prediction for the first
map of `hs` in `paper-v1-test`, 64 × 64 cells of 10 components.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchmarks.timing import milliseconds, problem_of, show
from benchnav import Grid
from benchnav.core import cvar
from benchnav.datagen import TerrainDataset, find_dataset
from benchnav.models import load_model, predict
from benchnav.planning import MPPI, Problem, Unicycle
from benchnav.planning.planners.mppi_rollouts import roll_out

LEVEL = 0.9


@dataclass(frozen=True, kw_only=True)
class Crab(Unicycle):
    """Robot that moves along x and y, without sine and cosine."""

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Advance one step."""
        moved = traversability * self.dt_s
        x = state[..., 0] + moved * action[..., 0]
        y = state[..., 1] + moved * action[..., 1]
        return torch.stack((x, y, state[..., 2] + moved)).movedim(0, -1)


@dataclass(frozen=True)
class Blind(Grid):
    """Grid whose lookups return the first cell for every position."""

    def lookup(self, padded: Tensor, x_m: Tensor, y_m: Tensor) -> Tensor:
        """Return the value of the first cell."""
        return padded[:, :1].expand_as(x_m) + 0 * x_m


def without(problem: Problem, headings: bool = False, lookups: bool = False) -> Problem:
    """Return a problem whose rollouts have no headings, no lookups or neither."""
    grid = Blind(*problem.grid.shape, problem.grid.resolution_m)
    if headings:
        problem = replace(problem, task=replace(problem.task, robot=Crab()))
    return (
        replace(problem, observation=replace(problem.observation, grid=grid))
        if lookups
        else problem
    )


def rollout_ms(problem: Problem) -> float:
    """Measure the rollouts of a step in milliseconds per episode."""
    planner = MPPI()
    state = planner.init(problem, torch.Generator().manual_seed(0))
    noise = state.noise.at(0)
    return milliseconds(
        lambda: roll_out(
            problem, problem.start, state.mean, noise, problem.goal_m, planner._advance
        )
    ) / len(problem)


def parts_of_cvar() -> list[dict[str, Any]]:
    """Measure a CVaR map and its parts."""
    dataset = TerrainDataset(find_dataset("paper-v1-test"))
    mixture = predict(load_model("paper-v1"), dataset.terrain("test/hs", [0]))
    flat = [
        values[0].flatten(1).double()
        for values in (mixture.weights, mixture.means, mixture.stds)
    ]
    cells = cvar.Cells(flat[0], flat[1], math.sqrt(0.5) / flat[2])
    tail = torch.full_like(cells.means[0], 1 - LEVEL)
    root = cvar._first_root(cells, tail)
    works = {
        "whole": lambda: mixture.cvar(LEVEL),
        "search for the VaR in float32": lambda: cvar._first_root(cells, tail),
        "F, its density and G at the VaR in float64": lambda: cells.around(root),
        "G at 0 in float64": lambda: cells.integral(0.0),
    }
    return [
        {"CVaR": name, "ms": milliseconds(work, 101)} for name, work in works.items()
    ]


def main() -> None:
    """Print both tables."""
    torch.set_num_threads(1)
    problem = problem_of(20)
    problems = {
        "whole": problem,
        "without headings": without(problem, headings=True),
        "without lookups": without(problem, lookups=True),
        "without both": without(problem, headings=True, lookups=True),
    }
    show(
        [
            {"rollouts": name, "ms an episode": rollout_ms(changed)}
            for name, changed in problems.items()
        ]
    )
    show(parts_of_cvar())


if __name__ == "__main__":
    main()
