"""Risk of the cost: action sequences are rolled out on whole fields of λ, and judged by the tail of what they cost.

A risk map tells each cell's risk on its own. What a way costs adds up over cells that hang together, and its tail is
that of the sum: CVaR over M fields of the cost of a sequence of actions on each. On fields and on a risk map alike,
ground of little λ may immobilise a robot (`advance_entrapped`), of which the motion model alone does not know. Source:
Cai et al. (2024), "EVORA: Deep evidential traversability learning for risk-aware off-road autonomy", CVaR-Cost.

Letters in shapes: B episodes, M fields, K samples, T steps, S state and A action dimensions, H×W cells, N cells framed
for lookups.
"""

import math

import torch
from torch import Tensor

from benchnav.core.grid import Grid
from benchnav.planning.objective import Objective
from benchnav.planning.planners.noise_bank import perturb
from benchnav.planning.problem import (
    Problem,
    ground_map,
    motion_traversability,
    predicted_traversability,
    stage_cost,
)
from benchnav.planning.robots import Robot, component_wise


def framed_fields(problem: Problem, fields: Tensor) -> Tensor:
    """Fields of λ with the problem's free space, as `Problem.padded_ground` has λ̂, an episode's one after another.

    Args:
        problem: B problems.
        fields: λ, shape [B, M, H, W].

    Returns:
        Shape [B·M, N].
    """
    free = problem.free[:, None].expand_as(fields)
    return ground_map(problem.grid, fields, free).flatten(0, 1)


def within_reach(problem: Problem, state: Tensor, seconds: float) -> Tensor:
    """Cells on which robots may be within some time, at top speed, bool, shape [B, H, W].

    Args:
        problem: B problems.
        state: where they are, shape [B, S].
        seconds: the time.
    """
    grid = problem.grid
    row, column = (torch.arange(size, device=state.device) for size in grid.shape)
    x, y = grid.centre_of(row[:, None], column)
    away = torch.hypot(x - state[:, 0, None, None], y - state[:, 1, None, None])
    return away <= problem.robot.top_speed_mps * seconds + grid.resolution_m  # as far as a cell's corner


def tail_cost(cost: Tensor, level: float) -> Tensor:
    """CVaR of the cost over equally likely fields: the mean of the worst share 1 − level of them.

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


def advance_entrapped(
    states: Tensor, cost: Tensor, held: Tensor, mean: Tensor, noise: Tensor, low: Tensor, high: Tensor,
    padded_ground: Tensor, target: Tensor, goal: Tensor, steps_left: Tensor, grid: Grid, robot: Robot,
    objective: Objective, min_traversability: float, goal_radius_m: float, below: float, most: int,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Rolls samples out as `mppi.advance_chunk` does, where ground of little λ immobilises a robot.

    One that was on such ground for `most` steps in a row stops there, and pays J of standing there, with the penalty
    of ground that is not free, until its time is over. Its states go on, and cost nothing more. One that has been at
    the goal has arrived, and is not immobilised on ground behind it.

    Args:
        states: shape [B, K, S].
        cost: so far, shape [B, K].
        held: steps in a row on immobilising ground, shape [B, K]; `most` of one that has stopped, −1 of one that has
            arrived.
        mean: of the actions, shape [B, T, A].
        noise: added to it, shape [T, A, K].
        low: least actions, shape [A].
        high: greatest actions, shape [A].
        padded_ground: as of `Problem`, shape [B, N].
        target: (x, y) to be reached, shape [B, 1, 2].
        goal: (x, y) of the goal, shape [B, 1, 2].
        steps_left: from the first of these steps until the time is over, shape [B, 1].
        grid: of the maps.
        robot: F.
        objective: J.
        min_traversability: least λ of motion.
        goal_radius_m: how near the goal a robot has arrived.
        below: λ under which ground immobilises a robot.
        most: steps in a row on such ground after which a robot is immobilised.

    Returns:
        States, cost and `held` after these steps.
    """
    for step in range(mean.shape[1]):
        action = perturb(mean[:, step, :, None], noise[step], low, high).movedim(1, 2)
        ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
        traversability, going = predicted_traversability(ground), held < most
        away = torch.hypot(states[..., 0] - goal[..., 0], states[..., 1] - goal[..., 1])
        longer = torch.where(traversability < below, held + 1, 0)
        longer = torch.where((held < 0) | (away < goal_radius_m), -1, longer)
        stops = going & (longer >= most)
        paid = stage_cost(objective, states, action, ground, target)
        standing = stage_cost(objective, states, torch.zeros_like(action), ground, target)
        rest = (steps_left - (step + 1)).clamp(min=0) * standing
        cost = cost + torch.where(going, paid + torch.where(stops, rest, 0), 0)
        states = robot(states, action, motion_traversability(ground, min_traversability))
        held = torch.where(going, longer, held)
    return component_wise(states), cost, held
