"""Risk of the cost: action sequences are rolled out on whole fields of λ, and judged by
the tail of what they cost.

A risk map tells each cell's risk on its own. What a way costs adds up over cells that
hang together, and its tail is
that of the sum: CVaR over M fields of the cost of a sequence of actions on each. On
fields and on a risk map alike, ground of little λ may immobilise a robot
(`advance_entrapped`), of which the motion model alone does not know. Source: Cai et al.
(2024), "EVORA: Deep evidential traversability learning for risk-aware off-road
autonomy", CVaR-Cost.

Letters in shapes: B episodes, M fields, K samples, T steps, S state and A action
dimensions, H×W cells, N cells framed for lookups.
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
    """Fields of λ with the problem's free space, as `Problem.padded_ground` has λ̂, an
    episode's one after another.

    Args:
        problem: B problems.
        fields: λ, shape [B, M, H, W].

    Returns:
        Shape [B·M, N].
    """
    free = problem.free[:, None].expand_as(fields)
    return ground_map(problem.grid, fields, free).flatten(0, 1)


def within_reach(problem: Problem, state: Tensor, seconds: float) -> Tensor:
    """Cells on which robots may be within some time, at top speed, bool, shape [B, H,
    W].

    Args:
        problem: B problems.
        state: where they are, shape [B, S].
        seconds: the time.
    """
    grid = problem.grid
    row, column = (torch.arange(size, device=state.device) for size in grid.shape)
    x, y = grid.centre_of(row[:, None], column)
    away = torch.hypot(x - state[:, 0, None, None], y - state[:, 1, None, None])
    # as far as a cell's corner
    return away <= problem.robot.top_speed_mps * seconds + grid.resolution_m


def tail_cost(cost: Tensor, level: float) -> Tensor:
    """CVaR of the cost over equally likely fields: the mean of the worst share 1 −
    level of them.

    Args:
        cost: shape [B, M, K].
        level: α in [0, 1); at 0 the mean.

    Returns:
        Shape [B, K]. Of a field that is in that share by a part alone the part counts.
    """
    if level == 0:
        return cost.mean(1)
    worst = (1 - level) * cost.shape[1]
    count = math.ceil(worst - 1e-9)
    most = cost.topk(count, dim=1).values
    return (most[:, :-1].sum(1) + (worst - count + 1) * most[:, -1]) / worst


class Entrapment(NamedTuple):
    """What immobilises a robot for good, and what that costs.

    Args:
        goal: (x, y) of the goal, shape [B, 1, 2].
        steps_left: from the first step of a rollout until the time is over, shape [B,
            1].
        goal_radius_m: how near the goal a robot has reached it.
        below: λ under which terrain immobilises a robot.
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
    held: Tensor,
    sampled: Sampled,
    padded_ground: Tensor,
    target: Tensor,
    entrapment: Entrapment,
    dynamics: Dynamics,
) -> tuple[Tensor, Tensor, Tensor]:
    """Rolls samples out as `mppi.advance_chunk` does, where ground of little λ
    immobilises a robot.

    One that was on such ground for `max_steps` steps in a row stops there, and pays J
    of standing there, with the penalty of ground that is not free, until its time is
    over. Its states go on, and cost nothing more. One that has been at the goal has
    arrived, and is not immobilised on ground behind it.

    Args:
        states: shape [B, K, S].
        cost: so far, shape [B, K].
        held: steps in a row on immobilising ground, shape [B, K]; `max_steps` of one
            that has stopped, −1 of one that has arrived.
        sampled: action sequences.
        padded_ground: as of `Problem`, shape [B, N].
        target: (x, y) to be reached, shape [B, 1, 2].
        entrapment: what immobilises a robot.
        dynamics: of the problem.

    Returns:
        States, cost and `held` after these steps.
    """
    goal, steps_left, goal_radius_m, below, most = entrapment
    grid, robot, objective, min_traversability = dynamics
    for step in range(sampled.mean.shape[1]):
        action = sampled_actions(sampled, step)
        ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
        traversability, going = predicted_traversability(ground), held < most
        away = torch.hypot(states[..., 0] - goal[..., 0], states[..., 1] - goal[..., 1])
        longer = torch.where(traversability < below, held + 1, 0)
        longer = torch.where((held < 0) | (away < goal_radius_m), -1, longer)
        stops = going & (longer >= most)
        paid = stage_cost(objective, states, action, ground, target)
        standing = stage_cost(
            objective, states, torch.zeros_like(action), ground, target
        )
        rest = (steps_left - (step + 1)).clamp(min=0) * standing
        cost = cost + torch.where(going, paid + torch.where(stops, rest, 0), 0)
        states = robot(
            states, action, motion_traversability(ground, min_traversability)
        )
        held = torch.where(going, longer, held)
    return component_wise(states), cost, held
