"""Risk of the cost: the tail of an action sequence's costs on joint samples of λ.

A risk map contains the risk of each cell. The cost of a path is a sum over correlated
cells, so its risk is not the sum of the cells' risks. Hence action sequences are rolled
out on M joint samples of the λ field, and scored by the CVaR of their costs over these
fields. On a field or a risk map, low λ may immobilise a robot (`advance_entrapped`),
which the motion model does not include. Source: Cai et al. (2024), "EVORA: Deep
evidential traversability learning for risk-aware off-road autonomy", CVaR-Cost.

Letters in shapes: B episodes, M fields, K samples, T steps, S state and A action
dimensions, H×W cells, N cells padded for lookups.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from benchnav.planning.planners.noise_bank import Sampled, sampled_actions
from benchnav.planning.problem import (
    Dynamics,
    Problem,
    ground_map,
    motion_traversability,
    predicted_traversability,
    stage_cost,
)
from benchnav.planning.robots import component_wise


def framed_fields(problem: Problem, fields: Tensor) -> Tensor:
    """Return padded fields of λ with the problem's free mask, as `Problem.padded_ground`.

    Args:
        problem: B problems.
        fields: λ, shape [B, M, H, W].

    Returns:
        Padded maps, M for each episode in turn, shape [B·M, N].
    """
    free = problem.free[:, None].expand_as(fields)
    return ground_map(problem.grid, fields, free).flatten(0, 1)


def within_reach(problem: Problem, state: Tensor, seconds: float) -> Tensor:
    """Return a mask of cells that robots may reach in a given time at top speed.

    Args:
        problem: B problems.
        state: robot states, shape [B, S].
        seconds: time in seconds.

    Returns:
        Mask, bool, shape [B, H, W].
    """
    grid = problem.grid
    row = torch.arange(grid.height, device=state.device)
    column = torch.arange(grid.width, device=state.device)
    x, y = grid.centre_of(row[:, None], column)
    dx = x - state[:, 0, None, None]
    dy = y - state[:, 1, None, None]
    distance_m = torch.hypot(dx, dy)
    reach_m = problem.robot.top_speed_mps * seconds
    return distance_m <= reach_m + grid.resolution_m  # beyond a cell's corner


def tail_cost(cost: Tensor, level: float) -> Tensor:
    """Return the CVaR of the cost: its mean over the worst 1 − level fraction of fields.

    Args:
        cost: cost on each field, shape [B, M, K].
        level: α in [0, 1); 0 for the mean.

    Returns:
        CVaR, shape [B, K]. A field that is only partly within the worst fraction counts
        with that part.
    """
    if level == 0:
        return cost.mean(1)
    n_worst = (1 - level) * cost.shape[1]
    count = math.ceil(n_worst - 1e-9)
    worst_costs = cost.topk(count, dim=1).values
    last_weight = n_worst - count + 1
    full_sum = worst_costs[:, :-1].sum(1)
    total = full_sum + last_weight * worst_costs[:, -1]
    return total / n_worst


class Entrapment(NamedTuple):
    """Permanent immobilisation of a robot, and its cost.

    Args:
        goal: goal (x, y) in metres, shape [B, 1, 2].
        steps_left: number of remaining steps at the start of a rollout, shape [B, 1].
        goal_radius_m: distance in metres below which a robot has reached the goal.
        below: λ below which terrain immobilises a robot.
        max_steps: consecutive steps on such terrain after which a robot is immobilised.
    """

    goal: Tensor
    steps_left: Tensor
    goal_radius_m: float
    below: float
    max_steps: int


def advance_entrapped(
    states: Tensor,
    cost: Tensor,
    dwell_steps: Tensor,
    sampled: Sampled,
    padded_ground: Tensor,
    target: Tensor,
    entrapment: Entrapment,
    dynamics: Dynamics,
) -> tuple[Tensor, Tensor, Tensor]:
    """Roll out samples as `mppi.advance_chunk`, where low λ immobilises a robot.

    A robot on such terrain for `max_steps` consecutive steps stops there. It pays J of
    standing there, with the penalty of non-free cells, until its time is over. Its
    states continue at no further cost. A robot that has reached the goal is no longer
    immobilised.

    Args:
        states: robot states, shape [B, K, S].
        cost: cost so far, shape [B, K].
        dwell_steps: consecutive steps on immobilising terrain; `max_steps` for a robot
            that has stopped, −1 for one that has reached the goal, shape [B, K].
        sampled: action sequences.
        padded_ground: padded maps as in `Problem`, shape [B, N].
        target: target (x, y) in metres, shape [B, 1, 2].
        entrapment: conditions of immobilisation.
        dynamics: dynamics of the problem.

    Returns:
        States, cost and `dwell_steps` after these steps.
    """
    goal, steps_left, goal_radius_m, below, max_steps = entrapment
    grid, robot, objective, min_traversability = dynamics
    for step in range(sampled.mean.shape[1]):
        action = sampled_actions(sampled, step)
        ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
        traversability = predicted_traversability(ground)
        going = dwell_steps < max_steps
        dx = states[..., 0] - goal[..., 0]
        dy = states[..., 1] - goal[..., 1]
        longer_dwell = torch.where(traversability < below, dwell_steps + 1, 0)
        at_goal = torch.hypot(dx, dy) < goal_radius_m
        has_arrived = (dwell_steps < 0) | at_goal
        longer_dwell = torch.where(has_arrived, -1, longer_dwell)
        stops = going & (longer_dwell >= max_steps)
        step_cost = stage_cost(objective, states, action, ground, target)
        no_action = torch.zeros_like(action)
        standing_cost = stage_cost(objective, states, no_action, ground, target)
        remaining_steps = (steps_left - (step + 1)).clamp(min=0)
        remaining_cost = remaining_steps * standing_cost
        step_cost = step_cost + torch.where(stops, remaining_cost, 0)
        cost = cost + torch.where(going, step_cost, 0)
        scale = motion_traversability(ground, min_traversability)
        states = robot(states, action, scale)
        dwell_steps = torch.where(going, longer_dwell, dwell_steps)
    return component_wise(states), cost, dwell_steps
