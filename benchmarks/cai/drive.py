"""Driving the trials: a loop of its own, in which two independent fields move the robot.

None of the simulation of `benchnav` is used. Letters in shapes: B trials.
"""

import torch
from torch import Tensor

from benchmarks.cai.task import GOAL_M, GOAL_RADIUS_M, STEPS
from benchnav.planning.planners.mppi import MPPI
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.sensor import Step


class ManyTrialsMPPI(MPPI):
    """MPPI that is compiled even at few samples: hundreds of trials of one shape share the compiling."""

    worth_compiling = 0


def drive(planner: MPPI, problem: Problem, traction: Tensor, generator: torch.Generator) -> Tensor:
    """Drives B trials until they have arrived or their time is over.

    Args:
        planner: is asked once a step; its computing takes no time of the trial's.
        problem: with what is predicted.
        traction: true linear and angular λ, shape [B, 2, H, W].
        generator: the planner's randomness, the same for all B.

    Returns:
        Time of arrival in seconds, infinite where there was none, shape [B].
    """
    arrival_s = torch.full((len(problem),), torch.inf)
    state, observed = problem.start, torch.full((len(problem),), torch.nan)
    plan_state = planner.init(problem, generator)
    for step in range(STEPS):
        action, plan_state, _ = planner.plan(
            Step(state=state, traversability=observed, time_s=step * problem.dt_s), plan_state
        )
        observed = traction_at(state, traction)[:, 0]
        running = arrival_s.isinf()
        state = torch.where(running[:, None], move(state, action, traction, problem.dt_s), state)
        arrival_s[running & has_arrived(state)] = (step + 1) * problem.dt_s
        if not arrival_s.isinf().any():
            break
    return arrival_s


def move(state: Tensor, action: Tensor, traction: Tensor, dt_s: float) -> Tensor:
    """Moves robots for one step.

    Args:
        state: (x, y, θ), shape [B, 3].
        action: (v, ω), shape [B, 2].
        traction: linear and angular λ, shape [B, 2, H, W].
        dt_s: time step.

    Returns:
        The next states, shape [B, 3].
    """
    linear, angular = traction_at(state, traction).unbind(1)
    heading, advance = state[:, 2], dt_s * linear * action[:, 0]
    return torch.stack(
        (
            state[:, 0] + advance * torch.cos(heading),
            state[:, 1] + advance * torch.sin(heading),
            heading + dt_s * angular * action[:, 1],
        ),
        dim=1,
    )


def traction_at(state: Tensor, traction: Tensor) -> Tensor:
    """Linear and angular λ in the cells of 1 m where robots stand, 0 off the map, shape [B, 2]."""
    height, width = traction.shape[2:]
    column, row = state[:, 0].floor().long(), state[:, 1].floor().long()
    on_map = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    here = traction[torch.arange(len(state)), :, row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return torch.where(on_map[:, None], here, 0.0)


def has_arrived(state: Tensor) -> Tensor:
    """Tells which robots are at the goal, bool, shape [B]."""
    return torch.hypot(state[:, 0] - GOAL_M[0], state[:, 1] - GOAL_M[1]) <= GOAL_RADIUS_M
