"""Driving straight at the goal: the baseline that a planner has to beat.

`Straight` is blind: it uses the goal alone. Planners with a global path recover by the
same control law.
Letters in shapes: B episodes, S state and A action dimensions.
"""

import math

import torch
from torch import Tensor

from benchnav.planning.planners.planner import Plan, Planner
from benchnav.planning.problem import Problem, Task
from benchnav.planning.robots import SPEED, STEERING, TURN_RATE, Robot
from benchnav.planning.sensing.sensor import Step

# Turn commanded for a radian of heading error: rad/s of turn rate, or rad of steering.
_TURN_GAIN = 4.0
# A robot that looks farther away than this turns before it drives, so that it leaves
# narrow places straight.
_AWAY_RAD = 0.2
# Greatest speed for a metre that is left, 1/s, so that a target is not overshot.
_APPROACH = 2.0
# Least share of the top speed of a robot that steers: it cannot turn while it stands.
_CREEP = 0.3

STEERS = ((SPEED, TURN_RATE), (SPEED, STEERING))


def turn_toward(state: Tensor, target_m: Tensor) -> Tensor:
    """Angles from the headings of states [*B, S] to positions [*B, 2], in [−π, π),
    shape [*B].
    """
    offset = target_m - state[..., :2]
    missing = torch.atan2(offset[..., 1], offset[..., 0]) - state[..., 2]
    return torch.remainder(missing + math.pi, 2 * math.pi) - math.pi


def steer_toward(state: Tensor, target_m: Tensor, robot: Robot) -> Tensor:
    """Actions that turn toward a target and drive at it, once the robot looks there.

    Args:
        state: shape [B, S], beginning with (x, y, θ).
        target_m: (x, y), shape [B, 2].
        robot: one of the actions `STEERS`.

    Returns:
        Actions within the bounds, shape [B, 2].
    """
    missing = turn_toward(state, target_m)
    low, high, rates = robot.action_low, robot.action_high, robot.action_rates
    # A robot of limited acceleration has to be able to end its turn in time.
    gain = _TURN_GAIN if rates is None else min(_TURN_GAIN, 2 * rates[1] / high[1])
    least = 0.0 if TURN_RATE in robot.action_names else _CREEP
    aligned = high[0] * (1 - missing.abs() / _AWAY_RAD).clamp(min=least)
    speed = torch.minimum(
        aligned, _APPROACH * torch.linalg.vector_norm(target_m - state[:, :2], dim=1)
    )
    actions = zip((speed, gain * missing), low, high, strict=True)
    return torch.stack(
        [action.clamp(least, most) for action, least, most in actions], dim=1
    )


class Straight(Planner[Problem]):
    """The blind baseline: full speed straight at the goal, whatever the ground is."""

    steers = STEERS
    blind = True

    def follows(self, task: Task) -> str:
        """That it minimises nothing; see `Planner`."""
        return "none (it drives straight at the goal)"

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        """Keeps the problem, for its goals; draws nothing. See `Planner`."""
        return problem

    def plan(self, step: Step, plan_state: Problem) -> tuple[Tensor, Problem, Plan]:
        """Steers toward the goal; see `Planner`."""
        action = steer_toward(step.state, plan_state.goal_m, plan_state.robot)
        line = torch.stack((step.state[:, :2], plan_state.goal_m), dim=1)
        return action, plan_state, Plan.empty(len(action), action.device, path=line)

    def revise(self, plan_state: Problem, problem: Problem) -> Problem:
        """Goes on as before; see `Planner`."""
        return problem

    def select(self, plan_state: Problem, members: Tensor) -> Problem:
        """Keeps some episodes; see `Planner`."""
        return plan_state.select(members)
