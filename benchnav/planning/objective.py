"""Objectives J: what a planner minimises.

An objective is an `Objective`, with `stage` and `terminal`; with `path_cost` it also
tells what a metre of a path costs, which planners that search paths minimise. `target`
is the goal, or a local planner's way-point; traversability is read at the state before
the move, as the risk setting gives it: the least λ̂ that motion is given does not bound
it. In the Gymnasium environment J is given the λ that the robot met. Ground that is not
free is no concern of J: the `Problem` adds its penalty. An objective whose constructor
has a parameter `robot` or `goal_radius_m` is given the task's. Source: paper III-C
and IV-A. Letters in
shapes: *B any leading dimensions, S state and A action dimensions.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, is_dataclass, replace

import torch
from torch import Tensor

from benchnav.core.errors import expect
from benchnav.core.specified import Specified
from benchnav.planning.robots import Robot

_WAYPOINT_M = 0.2  # a robot this near to a way-point has reached it


class Objective(Specified, ABC):
    """The base class of costs J, summed over a trajectory. Shapes broadcast over *B.

    `benchnav.testing.check_objective` tries whether one keeps its contract.
    """

    @abstractmethod
    def stage(
        self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor
    ) -> Tensor:
        """Cost of one step.

        Args:
            state: shape [*B, S], beginning with (x, y, θ).
            action: shape [*B, A].
            traversability: λ̂ at the state, in [0, 1] and not clamped, 0 off the map,
                shape [*B].
            target: (x, y) to be reached, shape [*B, 2].

        Returns:
            Shape [*B].
        """

    @abstractmethod
    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of the last state, shape [*B]; arguments as for `stage`."""

    def path_cost(self, traversability: Tensor, grade: Tensor) -> Tensor:
        """What a horizontal metre of a path costs; by default its length in 3D. A
        path's cost sums its pieces'.

        Args:
            traversability: the λ̂ that motion is planned with, shape [*B].
            grade: rise of that metre, negative downhill, shape [*B].

        Returns:
            Finite and above 0, shape [*B].
        """
        return torch.sqrt(1 + grade * grade)


class GoalDistance(Objective):
    """The paper's: distance to the target in metres, at each step. Source: paper IV-A."""

    def stage(
        self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor
    ) -> Tensor:
        """Cost of one step; see `Objective`."""
        return distance(state, target)

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of the last state; see `Objective`."""
        return distance(state, target)

    def path_cost(self, traversability: Tensor, grade: Tensor) -> Tensor:
        """Metres in 3D, which the paper's A* minimises; see `Objective`. Source: paper
        IV-A1.
        """
        return super().path_cost(traversability, grade)


@dataclass(frozen=True)
class TravelTime(Objective):
    """Seconds until the target: those of the steps before arrival, and at top speed for
    what is left.

    Args:
        robot: gives time step and top speed.
        goal_radius_m: a state this near to the target has arrived.
    """

    robot: Robot
    goal_radius_m: float

    def __post_init__(self) -> None:
        """Refuses a distance at which nothing arrives."""
        expect(
            self.goal_radius_m > 0, f"`goal_radius_m` > 0, got {self.goal_radius_m}."
        )

    def stage(
        self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor
    ) -> Tensor:
        """Cost of one step; see `Objective`."""
        away = distance(state, target)
        return self.robot.dt_s * (away > self.goal_radius_m).to(away.dtype)

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of the last state; see `Objective`."""
        return (distance(state, target) - self.goal_radius_m).clamp(
            min=0
        ) / self.robot.top_speed_mps

    def path_cost(self, traversability: Tensor, grade: Tensor) -> Tensor:
        """Seconds at top speed under λ̂; see `Objective`. Grade costs nothing: robots
        drive in the plane.
        """
        return 1 / (traversability * self.robot.top_speed_mps)


def toward_waypoints(objective: Objective) -> Objective:
    """J of a local planner: a way-point is reached at the point itself, not within the
    goal's radius of it.

    Else a way-point that is nearer than that radius, as in narrow places, would draw no
    robot. A dataclass with a field `goal_radius_m` is remade with the smaller radius;
    another objective is used as it is.
    """
    if not is_dataclass(objective) or "goal_radius_m" not in {
        entry.name for entry in fields(objective)
    }:
        return objective
    radius: float = objective.goal_radius_m
    return replace(objective, goal_radius_m=min(radius, _WAYPOINT_M))


def has_path_cost(objective: Objective) -> bool:
    """Whether an objective says itself what a metre of path costs."""
    return type(objective).path_cost is not Objective.path_cost


def distance(state: Tensor, target: Tensor) -> Tensor:
    """Distances of states [*B, S] to positions [*B, 2], shape [*B]."""
    offset_x, offset_y = state[..., 0] - target[..., 0], state[..., 1] - target[..., 1]
    return torch.sqrt(offset_x * offset_x + offset_y * offset_y)
