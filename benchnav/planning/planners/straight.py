"""Straight driving to the goal: the blind baseline.

`Straight` uses only the goal and no map. Planners with a global path use the same
control law in their recovery. Letters in shapes: B episodes, *B any leading dimensions,
S state dimensions.
"""

import math

import torch
from torch import Tensor

from benchnav.planning.planners.planner import Plan, Planner
from benchnav.planning.problem import Problem, Task
from benchnav.planning.robots import SPEED, STEERING, TURN_RATE, Robot
from benchnav.planning.sensing.sensor import Step

# Turn rate in rad/s, or steering angle in rad, per radian of heading error.
_TURN_GAIN = 4.0
# A robot with a larger heading error turns in place, so that it drives straight through
# narrow passages.
_MAX_HEADING_ERROR_RAD = 0.2
# Maximum speed per metre of remaining distance in 1/s, so that the robot does not
# overshoot.
_APPROACH_GAIN = 2.0
# Minimum fraction of the top speed of a robot that cannot turn in place.
_MIN_SPEED_FRACTION = 0.3

STEERS = ((SPEED, TURN_RATE), (SPEED, STEERING))


def turn_toward(state: Tensor, target_m: Tensor) -> Tensor:
    """Return angles from headings to the directions of targets, in [−π, π), shape [*B].

    Args:
        state: states that begin with (x, y, θ), shape [*B, S].
        target_m: positions (x, y) in metres, shape [*B, 2].
    """
    offset = target_m - state[..., :2]
    direction = torch.atan2(offset[..., 1], offset[..., 0])
    angle = direction - state[..., 2]
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def steer_toward(state: Tensor, target_m: Tensor, robot: Robot) -> Tensor:
    """Return actions that turn toward a target and then drive to it.

    Args:
        state: states that begin with (x, y, θ), shape [B, S].
        target_m: targets (x, y) in metres, shape [B, 2].
        robot: robot whose actions are one of the pairs in `STEERS`.

    Returns:
        Actions within the bounds, shape [B, 2].
    """
    heading_error = turn_toward(state, target_m)
    low = robot.action_low
    high = robot.action_high
    gain = _TURN_GAIN
    if robot.action_rates is not None:
        # A robot with limited acceleration must be able to stop its turn in time.
        _, max_rate = robot.action_rates
        gain = min(gain, 2 * max_rate / high[1])
    can_turn_in_place = TURN_RATE in robot.action_names
    min_fraction = 0.0 if can_turn_in_place else _MIN_SPEED_FRACTION
    relative_error = heading_error.abs() / _MAX_HEADING_ERROR_RAD
    fraction = (1 - relative_error).clamp(min=min_fraction)
    distance_m = torch.linalg.vector_norm(target_m - state[:, :2], dim=1)
    speed = torch.minimum(high[0] * fraction, _APPROACH_GAIN * distance_m)
    turn = gain * heading_error
    speed = speed.clamp(low[0], high[0])
    return torch.stack((speed, turn.clamp(low[1], high[1])), dim=1)


class Straight(Planner[Problem]):
    """Blind baseline, which drives straight to the goal at full speed."""

    steers = STEERS
    blind = True

    def follows(self, task: Task) -> str:
        """Return that the planner minimises no cost; see `Planner`."""
        return "none (it drives straight at the goal)"

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        """Return the problem as the plan state; see `Planner`."""
        return problem

    def plan(self, step: Step, plan_state: Problem) -> tuple[Tensor, Problem, Plan]:
        """Return actions toward the goal; see `Planner`."""
        action = steer_toward(step.state, plan_state.goal_m, plan_state.robot)
        line = torch.stack((step.state[:, :2], plan_state.goal_m), dim=1)
        plan = Plan.empty(len(action), action.device, path=line)
        return action, plan_state, plan

    def revise(self, plan_state: Problem, problem: Problem) -> Problem:
        """Return the new problem as the plan state; see `Planner`."""
        return problem

    def select(self, plan_state: Problem, members: Tensor) -> Problem:
        """Return the problems of some episodes; see `Planner`."""
        return plan_state.select(members)
