"""Risk of the cost: CVaR of the costs of an action sequence on joint samples of λ.

A risk map contains the risk of each cell. The cost of a path is a sum over correlated
cells, so its risk is not the sum of the cells' risks. Hence action sequences are rolled
out on M joint samples of the λ field, and scored by the CVaR of their costs over these
fields. Rollouts can also be immobilised by low λ (`advance_entrapped`), which the
motion model does not include. Source: Cai et al. (2024), "EVORA: Deep evidential
traversability learning for risk-aware off-road autonomy", CVaR-Cost.

Letters in shapes: B episodes, M fields, K samples, T steps, S state and A action
dimensions, H×W cells of a map, N cells of a padded map.
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


def pad_fields(problem: Problem, fields: Tensor) -> Tensor:
    """Return padded maps of λ fields and the free mask; see `Problem.padded_ground`.

    Args:
        problem: B problems.
        fields: fields of λ in [0, 1], shape [B, M, H, W].

    Returns:
        Padded maps, M consecutive maps for each episode, shape [B·M, N].
    """
    free = problem.free[:, None].expand_as(fields)
    return ground_map(problem.grid, fields, free).flatten(0, 1)


def within_reach(problem: Problem, state: Tensor, seconds: float) -> Tensor:
    """Return a mask of cells within the distance that robots drive at top speed.

    Args:
        problem: B problems.
        state: robot states, shape [B, S].
        seconds: driving time in seconds.

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
    # A robot can touch a cell without reaching its centre; the margin of a cell's side
    # exceeds the distance from centre to corner.
    return distance_m <= reach_m + grid.resolution_m


def tail_cost(cost: Tensor, level: float) -> Tensor:
    """Return the CVaR of the cost, its mean over the worst 1 − α fraction of fields.

    Args:
        cost: cost on each field, shape [B, M, K].
        level: level α in [0, 1); 0 for the mean.

    Returns:
        CVaR, shape [B, K]. If the worst fraction is not a whole number of fields, the
        last field has a weight below 1.
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
    """Conditions under which terrain immobilises a rollout.

    Args:
        goal: goal (x, y) in metres, shape [B, 1, 2].
        steps_left: number of steps from the start of the action sequences to the end of
            the time budget, shape [B, 1].
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
    """Roll out samples as in `mppi_rollouts.advance_chunk`; low λ immobilises robots.

    A robot is immobilised after `max_steps` consecutive steps on terrain of low λ. The
    cost of standing there for all remaining steps, with the penalty of non-free cells,
    is then added at once. The robot's later states have no cost. A robot that has
    reached the goal can no longer be immobilised.

    Args:
        states: robot states, shape [B, K, S].
        cost: cost of the previous steps, shape [B, K].
        dwell_steps: number of the last consecutive steps on immobilising terrain;
            `max_steps` for an immobilised robot, −1 for a robot that has reached the
            goal; shape [B, K].
        sampled: action sequences.
        padded_ground: maps as in `Problem.padded_ground`, shape [B, N].
        target: target (x, y) in metres, shape [B, 1, 2].
        entrapment: conditions of immobilisation.
        dynamics: grid, robot and objective.

    Returns:
        States, cost and `dwell_steps` after these steps.
    """
    goal, steps_left, goal_radius_m, below, max_steps = entrapment
    grid, robot, objective, min_traversability = dynamics
    for step in range(sampled.mean.shape[1]):
        action = sampled_actions(sampled, step)
        ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
        traversability = predicted_traversability(ground)
        is_mobile = dwell_steps < max_steps
        dx = states[..., 0] - goal[..., 0]
        dy = states[..., 1] - goal[..., 1]
        longer_dwell = torch.where(traversability < below, dwell_steps + 1, 0)
        at_goal = torch.hypot(dx, dy) < goal_radius_m
        has_reached_goal = (dwell_steps < 0) | at_goal
        longer_dwell = torch.where(has_reached_goal, -1, longer_dwell)
        becomes_immobile = is_mobile & (longer_dwell >= max_steps)
        step_cost = stage_cost(objective, states, action, ground, target)
        no_action = torch.zeros_like(action)
        standing_cost = stage_cost(objective, states, no_action, ground, target)
        remaining_steps = (steps_left - (step + 1)).clamp(min=0)
        remaining_cost = remaining_steps * standing_cost
        step_cost = step_cost + torch.where(becomes_immobile, remaining_cost, 0)
        cost = cost + torch.where(is_mobile, step_cost, 0)
        scale = motion_traversability(ground, min_traversability)
        states = robot(states, action, scale)
        dwell_steps = torch.where(is_mobile, longer_dwell, dwell_steps)
    return component_wise(states), cost, dwell_steps
