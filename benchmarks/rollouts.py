"""What MPPI's rollouts spend their time on: the same rollouts without one part or another.

    python benchmarks/rollouts.py

One thread, 5 000 samples × 50 steps, an episode of 20, compiled. Without headings the robot moves along x and y;
without lookups all ground is as in the first cell. Neither drives anywhere sensible.
"""

from dataclasses import dataclass, replace

import torch
from engine import milliseconds, problem_of
from rich.console import Console
from torch import Tensor

from benchnav.core.grid import Grid
from benchnav.planning.planners.mppi import MPPI, roll_out
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Unicycle


@dataclass(frozen=True, kw_only=True)
class Crab(Unicycle):
    """Moves along x and y: no sine and no cosine."""

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        moved = traversability * self.dt_s
        x = state[..., 0] + moved * action[..., 0]
        y = state[..., 1] + moved * action[..., 1]
        return torch.stack((x, y, state[..., 2] + moved)).movedim(0, -1)


@dataclass(frozen=True)
class Blind(Grid):
    """Reads the first cell, wherever a robot is."""

    def lookup(self, padded: Tensor, x_m: Tensor, y_m: Tensor) -> Tensor:
        return padded[:, :1].expand_as(x_m) + 0 * x_m


def rollout_ms(problem: Problem) -> float:
    """Time of the rollouts of a step, an episode."""
    planner = MPPI()
    state = planner.init(problem, torch.Generator().manual_seed(0))
    noise = state.noise.at(0)
    return milliseconds(
        lambda: roll_out(problem, problem.start, state.mean, noise, problem.goal_m, planner._advance)
    ) / len(problem)


def main() -> None:
    torch.set_num_threads(1)
    whole = problem_of(20)
    still = replace(whole, task=replace(whole.task, robot=Crab()))

    def blind(problem: Problem) -> Problem:
        grid = Blind(*problem.grid.shape, problem.grid.resolution_m)
        return replace(problem, observation=replace(problem.observation, grid=grid))

    for name, problem in (
        ("whole", whole),
        ("without headings", still),
        ("without lookups", blind(whole)),
        ("without both", blind(still)),
    ):
        Console().print(f"{name}: {rollout_ms(problem):.3f} ms an episode")


if __name__ == "__main__":
    main()
