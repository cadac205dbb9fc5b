"""Objectives J: what a planner minimises.

An objective is any object with `stage` and `terminal`. `target` is the goal, or a local planner's
way-point; traversability is read at the state before the move, as the risk setting gives it: the least λ̂
that motion is given does not bound it. In the Gymnasium environment J is given the λ that the robot met.
Ground that is not free is no concern of J: the `Problem` adds its penalty. An objective whose constructor
has a parameter `robot` is given the task's. Source: paper III-C and IV-A. Letters in shapes: *B any leading
dimensions, S state and A action dimensions.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.planning.robots import Robot


class Objective(Protocol):
    """The contract of a cost J, summed over a trajectory. Shapes broadcast over *B."""

    def stage(self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of one step.

        Args:
            state: shape [*B, S], beginning with (x, y, θ).
            action: shape [*B, A].
            traversability: λ̂ at the state, in [0, 1] and not clamped, 0 off the map, shape [*B].
            target: (x, y) to be reached, shape [*B, 2].

        Returns:
            Shape [*B].
        """
        ...

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of the last state, shape [*B]; arguments as for `stage`."""
        ...


class GoalDistance:
    """The paper's: distance to the target in metres, at each step. Source: paper IV-A."""

    def stage(self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of one step; see `Objective`."""
        return distance(state, target)

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of the last state; see `Objective`."""
        return distance(state, target)


@dataclass(frozen=True)
class TravelTime:
    """Seconds until the target: those of the steps before arrival, and at top speed for what is left.

    Args:
        robot: gives time step and top speed.
        arrival_m: a state this near to the target has arrived.
    """

    robot: Robot
    arrival_m: float = 0.5

    def __post_init__(self) -> None:
        """Refuses a distance at which nothing arrives."""
        if not self.arrival_m > 0:
            raise ConfigError(f"Expected `arrival_m` > 0, got {self.arrival_m}.")

    def stage(self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of one step; see `Objective`."""
        away = distance(state, target)
        return self.robot.dt_s * (away > self.arrival_m).to(away.dtype)

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of the last state; see `Objective`."""
        return (distance(state, target) - self.arrival_m).clamp(min=0) / self.robot.top_speed_mps


def distance(state: Tensor, target: Tensor) -> Tensor:
    """Distances of states [*B, S] to positions [*B, 2], shape [*B]."""
    offset_x, offset_y = state[..., 0] - target[..., 0], state[..., 1] - target[..., 1]
    return torch.sqrt(offset_x * offset_x + offset_y * offset_y)
