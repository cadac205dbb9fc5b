"""Objectives J, the costs that planners minimise.

An `Objective` has a cost of each step (`stage`) and of the last state (`terminal`). The
target of these costs is the goal, or a local planner's waypoint. `path_cost`, the cost
per metre of a path, is minimised by planners that search paths.

J receives λ̂ at the state before the motion, from the risk map and without the lower
bound `min_traversability`. In the Gymnasium environment, J receives the observed λ. J
does not include the penalty of non-free cells, which the `Problem` adds. If the
constructor of an objective has a parameter `robot` or `goal_radius_m`, it receives the
value of the task.

Source: paper III-C and IV-A. Letters in shapes: *B any leading dimensions, S state and
A action dimensions.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, is_dataclass, replace

import torch
from torch import Tensor

from benchnav.core.errors import expect
from benchnav.core.specified import Specified
from benchnav.planning.robots import Robot

_WAYPOINT_M = 0.2  # distance in metres below which a robot has reached a waypoint


class Objective(Specified, ABC):
    """Base class of objectives; `benchnav.testing.check_objective` checks the contract.

    J of a trajectory is the sum of the costs of its steps and the terminal cost. The
    leading dimensions *B of the arguments broadcast.
    """

    @abstractmethod
    def stage(
        self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor
    ) -> Tensor:
        """Return the cost of a step.

        Args:
            state: states that begin with (x, y, θ), shape [*B, S].
            action: actions, shape [*B, A].
            traversability: λ̂ of the risk map at the state, in [0, 1], 0 off the map,
                shape [*B].
            target: target (x, y) in metres, shape [*B, 2].

        Returns:
            Cost, shape [*B].
        """

    @abstractmethod
    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Return the terminal cost, shape [*B]; arguments as for `stage`."""

    def path_cost(self, traversability: Tensor, grade: Tensor) -> Tensor:
        """Return the cost per horizontal metre of path; by default the length in 3D.

        The cost of a path is the sum of the costs of its segments.

        Args:
            traversability: λ̂ that scales motion, at least `min_traversability`, shape
                [*B].
            grade: rise per horizontal metre, negative downhill, shape [*B].

        Returns:
            Cost, finite and above 0, shape [*B].
        """
        return torch.sqrt(1 + grade * grade)


class GoalDistance(Objective):
    """The paper's J: distance to the target in metres, at each step (paper IV-A)."""

    def stage(
        self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor
    ) -> Tensor:
        """Return the cost of a step; see `Objective`."""
        return distance(state, target)

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Return the terminal cost; see `Objective`."""
        return distance(state, target)

    def path_cost(self, traversability: Tensor, grade: Tensor) -> Tensor:
        """Return the length in 3D, as the paper's A* uses it (paper IV-A1)."""
        return super().path_cost(traversability, grade)


@dataclass(frozen=True)
class TravelTime(Objective):
    """Time to the target in seconds.

    It is the time until the target is reached, or until the end of a trajectory plus
    the time to drive the remaining distance at top speed.

    Args:
        robot: robot with its time step and top speed.
        goal_radius_m: distance in metres within which a state has reached the target.
    """

    robot: Robot
    goal_radius_m: float

    def __post_init__(self) -> None:
        """Validate the radius."""
        expect(
            self.goal_radius_m > 0, f"`goal_radius_m` > 0, got {self.goal_radius_m}."
        )

    def stage(
        self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor
    ) -> Tensor:
        """Return the cost of a step; see `Objective`."""
        distance_m = distance(state, target)
        is_away = distance_m > self.goal_radius_m
        return self.robot.dt_s * is_away.to(distance_m.dtype)

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Return the terminal cost; see `Objective`."""
        remaining_m = (distance(state, target) - self.goal_radius_m).clamp(min=0)
        return remaining_m / self.robot.top_speed_mps

    def path_cost(self, traversability: Tensor, grade: Tensor) -> Tensor:
        """Return the seconds per metre at top speed under λ̂; see `Objective`.

        The grade has no effect, since the robots' motion is two-dimensional.
        """
        return 1 / (traversability * self.robot.top_speed_mps)


def toward_waypoints(objective: Objective) -> Objective:
    """Return an objective for driving to waypoints, with a small target radius.

    With the goal's radius, a waypoint would not attract a robot that is within this
    radius, for example in a narrow passage. A dataclass with a field `goal_radius_m` is
    copied with the smaller radius. Other objectives are returned unchanged.
    """
    if not is_dataclass(objective):
        return objective
    names = {entry.name for entry in fields(objective)}
    if "goal_radius_m" not in names:
        return objective
    radius: float = objective.goal_radius_m
    return replace(objective, goal_radius_m=min(radius, _WAYPOINT_M))


def has_path_cost(objective: Objective) -> bool:
    """Return whether the class of an objective overrides `Objective.path_cost`."""
    return type(objective).path_cost is not Objective.path_cost


def distance(state: Tensor, target: Tensor) -> Tensor:
    """Return distances of states [*B, S] to positions [*B, 2], shape [*B]."""
    dx = state[..., 0] - target[..., 0]
    dy = state[..., 1] - target[..., 1]
    return torch.sqrt(dx * dx + dy * dy)
