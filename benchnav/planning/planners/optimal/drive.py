"""Closed-loop simulation of planners on a known λ field, as in the world.

λ is read where a robot stands at the start of a step, and so is whether that
immobilises it. Nothing is drawn, so a robot that repeats the actions in the same world
repeats the drive.
Letters in shapes: B episodes, T steps, S state and A action dimensions.
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
    """Drives from the start of each episode.

    Args:
        states: from the first to the last, NaN from then on, shape [B, T + 1, S].
        actions: those taken, NaN from then on, shape [B, T, A].
        steps: steps until the goal is reached, infinite where it is not, shape [B].
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
    """Drive a planner to the end of every episode.

    Args:
        plan: `plan` of a `Planner`.
        select: `select` of a `Planner`.
        plan_state: from `init`.
        problem: B problems.
        field: λ, shape [B, H, W].
        rival: the simulation ends where this drive has reached the goal by then; None
            for no such drive.
    """
    grid, robot, immobile = problem.grid, problem.robot, problem.immobile
    low, high = problem.action_bounds
    ground = grid.pad(field.to(problem.start), outside=0.0)
    limit = (problem.time_budget_s / problem.dt_s).round()
    longest = int(limit.max())
    if rival is not None:
        limit = torch.minimum(limit, rival.steps)
    states = problem.start.new_full(
        (len(problem), longest + 1, problem.start.shape[1]), torch.nan
    )
    actions = problem.start.new_full((len(problem), longest, len(low)), torch.nan)
    arrival = torch.full_like(problem.time_budget_s, torch.inf)
    states[:, 0] = problem.start
    running = torch.arange(len(problem), device=ground.device)
    state, dwell = problem.start, torch.zeros_like(running)
    observed = torch.full_like(state[:, 0], torch.nan)
    for count in range(longest):
        step = Step(state=state, traversability=observed, time_s=count * problem.dt_s)
        action, plan_state, _ = plan(step, plan_state)
        observed = grid.lookup(ground[running], state[:, 0], state[:, 1])
        state = robot(state.clone(), action.clamp(low, high), observed)
        states[running, count + 1], actions[running, count] = state, action
        arrived = distance(state, problem.goal_m[running]) < problem.goal_radius_m
        arrival[running[arrived]] = count + 1.0
        ended = (
            arrived
            | ~grid.contains(state[:, 0], state[:, 1])
            | (count + 1 >= limit[running])
        )
        if immobile is not None:
            dwell = torch.where(observed < immobile.below, dwell + 1, 0)
            ended = ended | (dwell >= steps_in(immobile.for_s, problem.dt_s))
        if bool(ended.any()):
            running_on = (~ended).nonzero()[:, 0]
            if len(running_on) == 0:
                break
            plan_state = select(plan_state, running_on)
            running, state, dwell, observed = (
                running[running_on],
                state[running_on],
                dwell[running_on],
                observed[running_on],
            )
    return Drive(states=states, actions=actions, steps=arrival)


def earlier(first: Drive, second: Drive) -> Drive:
    """Return of each episode the drive that reaches the goal earlier; the first where
    both are as early.
    """
    takes = (second.steps < first.steps)[:, None, None]
    return Drive(
        states=torch.where(takes, second.states, first.states),
        actions=torch.where(takes, second.actions, first.actions),
        steps=torch.minimum(first.steps, second.steps),
    )
