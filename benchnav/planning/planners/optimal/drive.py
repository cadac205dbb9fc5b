"""Closed-loop simulation of planners on a known λ field, by the rules of the world.

λ of a step is λ at the robot's position at the start of the step, also for
immobilisation. The simulation is deterministic, so a robot that repeats the actions in
the same world repeats the drive. Letters in shapes: B episodes, T steps, S state and A
action dimensions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.planning.objective import distance
from benchnav.planning.planners.planner import Plan
from benchnav.planning.problem import Problem
from benchnav.planning.robots import steps_in
from benchnav.planning.sensing.sensor import Step


@dataclass(frozen=True, kw_only=True)
class Drive(Batch):
    """Simulated drives of B episodes.

    Args:
        states: robot states from the start on, NaN after the end, shape [B, T + 1, S].
        actions: actions from the start on, NaN after the end, shape [B, T, A].
        steps: number of steps until the goal is reached, or infinity if it is not
            reached, shape [B].
    """

    states: Tensor
    actions: Tensor
    steps: Tensor


def simulate(
    plan: Callable[[Step, Any], tuple[Tensor, Any, Plan]],
    select: Callable[[Any, Tensor], Any],
    plan_state: Any,
    problem: Problem,
    field: Tensor,
    rival: Drive | None = None,
) -> Drive:
    """Return the drives of a planner, simulated to the end of every episode.

    Args:
        plan: `plan` of a `Planner`.
        select: `select` of a `Planner`.
        plan_state: plan state from `init` of the planner.
        problem: B problems.
        field: λ of each cell, shape [B, H, W].
        rival: drives that end the simulation of an episode as soon as they reach the
            goal; None for no such drives.
    """
    grid = problem.grid
    immobile = problem.immobile
    start = problem.start
    dt_s = problem.dt_s
    low, high = problem.action_bounds
    ground = grid.pad(field.to(start), outside=0.0)
    limit = (problem.time_budget_s / dt_s).round()
    max_steps = int(limit.max())
    if rival is not None:
        limit = torch.minimum(limit, rival.steps)
    n_episodes, n_dims = start.shape
    states = start.new_full((n_episodes, max_steps + 1, n_dims), torch.nan)
    actions = start.new_full((n_episodes, max_steps, len(low)), torch.nan)
    arrival = torch.full_like(problem.time_budget_s, torch.inf)
    states[:, 0] = start
    running = torch.arange(n_episodes, device=ground.device)
    state = start
    dwell = torch.zeros_like(running)
    observed = torch.full_like(state[:, 0], torch.nan)
    for count in range(max_steps):
        step = Step(state=state, traversability=observed, time_s=count * dt_s)
        action, plan_state, _ = plan(step, plan_state)
        observed = grid.lookup(ground[running], state[:, 0], state[:, 1])
        state = problem.robot(state.clone(), action.clamp(low, high), observed)
        states[running, count + 1] = state
        actions[running, count] = action
        arrived = distance(state, problem.goal_m[running]) < problem.goal_radius_m
        arrival[running[arrived]] = count + 1.0
        off_map = ~grid.contains(state[:, 0], state[:, 1])
        timed_out = count + 1 >= limit[running]
        ended = arrived | off_map | timed_out
        if immobile is not None:
            dwell = torch.where(observed < immobile.below, dwell + 1, 0)
            ended = ended | (dwell >= steps_in(immobile.for_s, dt_s))
        if bool(ended.any()):
            remaining = (~ended).nonzero()[:, 0]
            if len(remaining) == 0:
                break
            plan_state = select(plan_state, remaining)
            running = running[remaining]
            state = state[remaining]
            dwell = dwell[remaining]
            observed = observed[remaining]
    return Drive(states=states, actions=actions, steps=arrival)


def earlier(first: Drive, second: Drive) -> Drive:
    """Return the drive of each episode that reaches the goal earlier.

    If both drives reach the goal at the same time, the first is returned.
    """
    is_earlier = (second.steps < first.steps)[:, None, None]
    return Drive(
        states=torch.where(is_earlier, second.states, first.states),
        actions=torch.where(is_earlier, second.actions, first.actions),
        steps=torch.minimum(first.steps, second.steps),
    )
