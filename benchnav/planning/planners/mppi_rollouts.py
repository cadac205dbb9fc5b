"""Rollouts of MPPI: sampled action sequences, their costs and weights.

Letters in shapes: B episodes, M fields, K samples, T horizon steps, N cells of a padded
map, S state and A action dimensions.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchnav.core.grid import Grid
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import Objective
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.cost_risk import Entrapment, tail_cost
from benchnav.planning.planners.noise_bank import Sampled, perturb, sampled_actions
from benchnav.planning.planners.planner import rollout_path
from benchnav.planning.problem import (
    Dynamics,
    Problem,
    motion_traversability,
    stage_cost,
    terminal_cost,
)
from benchnav.planning.robots import component_wise, steps_in

# Rollouts are compiled for this number of steps. Code for the whole horizon would take
# much longer to compile, and would run no faster.
_CHUNK_STEPS = 10
BATCHED_ARGUMENTS = (0, 1, 2, 6, 7)
"""Indices of the arguments of `advance_chunk` that have an episode dimension.

They are states, cost, mean, padded_ground and target; each item of a tuple counts.
"""
ENTRAPPED_BATCHED_ARGUMENTS = (0, 1, 2, 3, 7, 8, 9, 10)
"""Indices of the arguments of `advance_entrapped` that have an episode dimension.

They are states, cost, dwell_steps, mean, padded_ground, target, goal and steps_left;
each item of a tuple counts.
"""
_PLOTTED_SAMPLES = 40
_MIN_SPREAD = 1e-30  # Above 0, so that samples of equal cost get equal weights.


def control_cost(mean: Tensor, noise: Tensor, scale: Tensor) -> Tensor:
    """Return the information-theoretic control cost uᵀΣ⁻¹ε.

    Args:
        mean: mean action sequences u, shape [B, T, A].
        noise: unclipped noise ε, shape [T, A, K].
        scale: standard deviations of the noise, Σ = diag(scale²), shape [A].

    Returns:
        Cost, shape [B, K].
    """
    precision_mean = mean / scale**2
    return torch.einsum("bta,tak->bk", precision_mean, noise)


class Dwell(NamedTuple):
    """Dwell times of robots on immobilising terrain.

    Args:
        dwell_steps: number of the last consecutive steps on such terrain, shape [B].
        time_s: time since the start of the episodes in seconds.
    """

    dwell_steps: Tensor
    time_s: float


class TerminalInputs(NamedTuple):
    """Inputs of the terminal costs of rollouts.

    Args:
        padded_ground: padded maps of λ, M consecutive maps for each episode, shape
            [B·M, N].
        target: target (x, y) in metres, shape [B·M, 1, 2].
        grid: size and resolution of the maps.
        objective: objective J.
        fields: number of fields M.
        level: level α of the CVaR over the fields, in [0, 1).
        is_mobile: mask of rollouts that are not immobilised, bool, shape [B·M, K]; None
            if terrain does not immobilise rollouts.
        cost_to_go: costs of the cheapest paths, padded by `astar.pad_costs`, shape
            [B, 2, N]; None if J provides the terminal cost.
    """

    padded_ground: Tensor
    target: Tensor
    grid: Grid
    objective: Objective
    fields: int = 1
    level: float = 0.0
    is_mobile: Tensor | None = None
    cost_to_go: Tensor | None = None


def roll_out(
    problem: Problem,
    state: Tensor,
    mean: Tensor,
    noise: Tensor,
    target_m: Tensor,
    advance: Callable[..., Any],
    ground: Tensor | None = None,
    dwell: Dwell | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Roll out sampled action sequences and sum their costs, without terminal costs.

    The cost of a step is its stage cost under J plus the penalty of non-free cells.

    Args:
        problem: B problems.
        state: initial states, shape [B, S].
        mean: mean action sequences, shape [B, T, A].
        noise: noise that is added to each mean before clipping, shape [T, A, K].
        target_m: targets (x, y) in metres, shape [B, 2].
        advance: `advance_chunk`, or `advance_entrapped` if `dwell` is given; either may
            be compiled.
        ground: padded maps of λ, M for each episode, from `pad_fields`, shape
            [B·M, N]; None for λ̂.
        dwell: dwell times on immobilising terrain; None if terrain does not immobilise
            rollouts.

    Returns:
        The last states, shape [B·M, K, S]; the costs, shape [B·M, K]; and a mask of
        rollouts that are not immobilised, bool, shape [B·M, K], or None without
        `dwell`.
    """
    ground = problem.padded_ground if ground is None else ground
    count = len(ground) // len(problem)
    state = state.repeat_interleave(count, 0)
    mean = mean.repeat_interleave(count, 0)
    target_m = target_m.repeat_interleave(count, 0)
    states = component_wise(state[:, None].expand(-1, noise.shape[2], -1))
    # All arguments are made contiguous, since PyTorch compiles each layout separately.
    target = target_m[:, None].contiguous()
    cost = state.new_zeros(states.shape[:2])
    low, high = problem.action_bounds
    chunks = []
    for begin in range(0, mean.shape[1], _CHUNK_STEPS):
        chunk = slice(begin, begin + _CHUNK_STEPS)
        chunk_mean = mean[:, chunk].contiguous()
        chunks.append(Sampled(chunk_mean, noise[chunk], low, high))
    dynamics = problem.dynamics
    immobile = problem.immobile
    if dwell is None or immobile is None:
        for sampled in chunks:
            states, cost = advance(states, cost, sampled, ground, target, dynamics)
        return states, cost, None
    max_steps = steps_in(immobile.for_s, problem.dt_s)
    dwell_steps = dwell.dwell_steps.repeat_interleave(count, 0)[:, None]
    dwell_steps = dwell_steps.expand_as(cost).clamp(max=max_steps - 1).contiguous()
    time_left_s = problem.time_budget_s - dwell.time_s
    steps_left = (time_left_s / problem.dt_s).round().to(state)
    steps_left = steps_left.repeat_interleave(count, 0)[:, None]
    goal = problem.goal_m.repeat_interleave(count, 0)[:, None].contiguous()
    for index, sampled in enumerate(chunks):
        chunk_steps_left = steps_left - index * _CHUNK_STEPS
        rules = Entrapment(
            goal, chunk_steps_left, problem.goal_radius_m, immobile.below, max_steps
        )
        states, cost, dwell_steps = advance(
            states, cost, dwell_steps, sampled, ground, target, rules, dynamics
        )
    return states, cost, dwell_steps < max_steps


def advance_chunk(
    states: Tensor,
    cost: Tensor,
    sampled: Sampled,
    padded_ground: Tensor,
    target: Tensor,
    dynamics: Dynamics,
) -> tuple[Tensor, Tensor]:
    """Roll out samples over a chunk of the horizon, and add the costs of its steps.

    Args:
        states: robot states, shape [B, K, S].
        cost: cost of the previous steps, shape [B, K].
        sampled: action sequences of the chunk.
        padded_ground: maps as in `Problem.padded_ground`, shape [B, N].
        target: target (x, y) in metres, shape [B, 1, 2].
        dynamics: grid, robot and objective.

    Returns:
        The states after the chunk, and the cost that includes its steps.
    """
    grid, robot, objective, min_traversability = dynamics
    for step in range(sampled.mean.shape[1]):
        action = sampled_actions(sampled, step)
        ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
        cost = cost + stage_cost(objective, states, action, ground, target)
        traversability = motion_traversability(ground, min_traversability)
        states = robot(states, action, traversability)
    return component_wise(states), cost


def weigh(
    states: Tensor,
    cost: Tensor,
    sampled: Sampled,
    terminal_inputs: TerminalInputs,
    temperature: float | None,
    temperature_share: float,
) -> tuple[Tensor, Tensor]:
    """Weigh samples by exp(−cost / temperature), and move the mean.

    Args:
        states: last states of the rollouts, shape [B·M, K, S].
        cost: cost of the rollouts without terminal cost, shape [B·M, K].
        sampled: action sequences of the whole horizon.
        terminal_inputs: inputs of the terminal costs.
        temperature: temperature in the units of J; None to use `temperature_share`.
        temperature_share: temperature as a fraction of `cost_spread`.

    Returns:
        Weights of the samples, shape [B, K], which sum to 1 over K, and the new mean
        action sequences, shape [B, T, A].
    """
    cost, cost_per_field = total_cost(states, cost, terminal_inputs)
    scale: Tensor | float | None = temperature
    if scale is None:
        stopped = None
        if terminal_inputs.is_mobile is not None:
            is_stopped = ~terminal_inputs.is_mobile
            stopped = is_stopped.unflatten(0, (-1, terminal_inputs.fields)).sum(1)
        scale = temperature_share * cost_spread(cost, cost_per_field, stopped)
    min_cost = cost.amin(dim=1, keepdim=True)
    weights = torch.softmax((min_cost - cost) / scale, dim=1)
    mean = average(sampled.mean, sampled.noise, weights, sampled.low, sampled.high)
    return weights, mean


def total_cost(
    states: Tensor, cost: Tensor, terminal_inputs: TerminalInputs
) -> tuple[Tensor, Tensor]:
    """Return the costs of samples, with terminal costs.

    The cost of a sample is the CVaR of its costs on M fields. An immobilised rollout
    has no terminal cost.

    Args:
        states: last states of the rollouts, shape [B·M, K, S].
        cost: cost of the rollouts without terminal cost, shape [B·M, K].
        terminal_inputs: inputs of the terminal costs.

    Returns:
        Cost of each sample, shape [B, K], and its cost on each field, shape [B, M, K].
    """
    padded_ground, target, grid, objective, fields, level, is_mobile, cost_to_go = (
        terminal_inputs
    )
    ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
    if cost_to_go is None:
        end_cost = terminal_cost(objective, states, ground, target)
    else:
        # All fields of an episode share one map of the cost to go.
        episode_states = states.unflatten(0, (-1, fields)).flatten(1, 2)
        x, y = episode_states[..., 0], episode_states[..., 1]
        path_cost = astar.cost_at(grid, cost_to_go, x, y)
        end_cost = path_cost.view_as(cost) + PENALTY * (ground <= 0)
    if is_mobile is not None:
        end_cost = torch.where(is_mobile, end_cost, 0)
    cost = cost + end_cost
    cost_per_field = cost.unflatten(0, (-1, fields))
    if fields > 1:
        cost = tail_cost(cost_per_field, level)
    return cost, cost_per_field


def cost_spread(
    cost: Tensor, cost_per_field: Tensor | None = None, stopped: Tensor | None = None
) -> Tensor:
    """Return the mean difference between the costs and the minimum cost.

    It is the unit of a relative temperature. Samples that cross more non-free cells
    than the best sample, summed over steps and fields, are excluded. Otherwise the
    penalty of such cells would set the temperature, and all paths over free terrain
    would have nearly equal weights. For the same reason, samples that are immobilised
    on more fields than the best sample are excluded.

    The number of steps in non-free cells is the cost in units of the penalty, rounded.
    Hence the spread of J itself should be less than half the penalty.

    Args:
        cost: cost of each sample, shape [B, K].
        cost_per_field: cost on each field, shape [B, M, K]; None for a single field.
        stopped: number of fields on which each sample is immobilised, shape [B, K];
            None for 0.

    Returns:
        Mean difference, > 0, shape [B, 1].
    """
    if cost_per_field is None:
        cost_per_field = cost[:, None]
    best = cost.argmin(dim=1, keepdim=True)
    index = best[:, None].expand(-1, cost_per_field.shape[1], -1)
    excess_per_field = cost_per_field - cost_per_field.gather(2, index)
    penalties_per_field = (excess_per_field / PENALTY + 0.5).floor()
    is_counted = penalties_per_field.sum(1) <= 0
    if stopped is not None:
        is_counted = is_counted & (stopped <= stopped.gather(1, best))
    excess = cost - cost.amin(dim=1, keepdim=True)
    total = torch.where(is_counted, excess, 0).sum(dim=1, keepdim=True)
    spread = total / is_counted.sum(dim=1, keepdim=True)
    return spread.clamp(min=_MIN_SPREAD)


def average(
    mean: Tensor, noise: Tensor, weights: Tensor, low: Tensor, high: Tensor
) -> Tensor:
    """Return the mean moved by weighted noise, clip(u + Σ w·ε), shape [B, T, A]."""
    offset = (noise * weights[:, None, None]).sum(-1)
    return torch.clamp(mean + offset, low, high)


def plotted_paths(
    problem: Problem,
    state: Tensor,
    updated: Tensor,
    mean: Tensor,
    noise: Tensor,
    weights: Tensor,
) -> dict[str, Tensor]:
    """Return the paths of the updated mean and of the best samples, for figures.

    Args:
        problem: B problems.
        state: initial states, shape [B, S].
        updated: updated mean action sequences, shape [B, T, A].
        mean: mean action sequences before the update, shape [B, T, A].
        noise: noise of the samples, shape [T, A, K].
        weights: weights of the samples, shape [B, K].

    Returns:
        Layers `path` and `samples` of a `Plan`.
    """
    count = min(_PLOTTED_SAMPLES, weights.shape[1])
    best = weights.topk(count, dim=1).indices
    best_noise = noise[..., best].movedim(2, 0)
    samples = perturb(mean[..., None], best_noise, *problem.action_bounds)
    actions = torch.cat((updated[..., None], samples), dim=3)
    paths = rollout_path(problem, state, actions)
    return {"path": paths[:, 0], "samples": paths[:, 1:]}
