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

# A chunk of the horizon compiles in seconds and runs as fast as the unrolled horizon.
_CHUNK_STEPS = 10
OF_EPISODES = (0, 1, 2, 6, 7)
"""Arguments of `advance_chunk` with an episode dimension: states, cost, mean,
padded_ground, target.
"""
ENTRAPPED_OF_EPISODES = (0, 1, 2, 3, 7, 8, 9, 10)
"""Arguments of `advance_entrapped` with an episode dimension: states, cost,
dwell_steps, mean, padded_ground, target, goal, steps_left.
"""
_DRAWN_SAMPLES = 40
_MIN_SPREAD = 1e-30  # > 0, so that samples of equal cost have equal weights


def control_cost(mean: Tensor, noise: Tensor, scale: Tensor) -> Tensor:
    """Return the information-theoretic control cost uᵀΣ⁻¹ε.

    Args:
        mean: mean action sequences u, shape [B, T, A].
        noise: unclipped noise ε, shape [T, A, K].
        scale: standard deviations, Σ = diag(scale²), shape [A].

    Returns:
        Cost, shape [B, K].
    """
    precision_mean = mean / scale**2
    return torch.einsum("bta,tak->bk", precision_mean, noise)


class Dwell(NamedTuple):
    """Dwell times of robots on immobilising terrain.

    Args:
        dwell_steps: consecutive steps on such terrain, shape [B].
        time_s: time since the start in seconds.
    """

    dwell_steps: Tensor
    time_s: float


class Ends(NamedTuple):
    """Terminal costs of rollouts.

    Args:
        padded_ground: padded maps, M for each episode in turn, shape [B·M, N].
        target: target (x, y) in metres, shape [B·M, 1, 2].
        grid: size and resolution of the maps.
        objective: J.
        fields: number of fields M.
        level: α of the CVaR over fields.
        going: mask of rollouts that have not stopped, bool, shape [B·M, K]; None
            without entrapment.
        to_go: costs of the cheapest paths, as in `astar.framed`, shape [B, 2, N]; None
            if the terminal cost is that of J.
    """

    padded_ground: Tensor
    target: Tensor
    grid: Grid
    objective: Objective
    fields: int = 1
    level: float = 0.0
    going: Tensor | None = None
    to_go: Tensor | None = None


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
    """Roll out sampled action sequences, summing J and the penalty of non-free cells.

    Args:
        problem: B problems.
        state: initial states, shape [B, S].
        mean: mean action sequences, shape [B, T, A].
        noise: offsets of every mean, shape [T, A, K]; their sum with the mean is
            clipped to the action bounds.
        target_m: targets (x, y) in metres, shape [B, 2].
        advance: `advance_chunk`, or `advance_entrapped` with `dwell`, or its compiled
            form.
        ground: padded maps, M for each episode, as in `framed_fields`, shape [B·M, N];
            None for λ̂.
        dwell: dwell times on immobilising terrain; None without entrapment.

    Returns:
        The last states, shape [B·M, K, S]; the cost without terminal cost, shape
        [B·M, K]; and, with `dwell`, a mask of rollouts that have not stopped, bool,
        shape [B·M, K].
    """
    ground = problem.padded_ground if ground is None else ground
    count = len(ground) // len(problem)
    state = state.repeat_interleave(count, 0)
    mean = mean.repeat_interleave(count, 0)
    target_m = target_m.repeat_interleave(count, 0)
    states = component_wise(state[:, None].expand(-1, noise.shape[2], -1))
    # All arguments are contiguous, since each layout is compiled separately.
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
    """Roll out samples over a chunk of the horizon, and add their costs.

    Args:
        states: robot states, shape [B, K, S].
        cost: cost so far, shape [B, K].
        sampled: action sequences of the chunk.
        padded_ground: padded maps as in `Problem`, shape [B, N].
        target: target (x, y) in metres, shape [B, 1, 2].
        dynamics: dynamics of the problem.

    Returns:
        States and cost after these steps.
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
    ends: Ends,
    temperature: float | None,
    temperature_share: float,
) -> tuple[Tensor, Tensor]:
    """Add terminal costs, weigh samples by exp(−cost / temperature) and move the mean.

    Args:
        states: last states of the rollouts, shape [B·M, K, S].
        cost: cost of the rollouts without terminal cost, shape [B·M, K].
        sampled: action sequences of the whole horizon.
        ends: terminal costs.
        temperature: temperature in the units of J; None for a relative one.
        temperature_share: relative temperature, as a fraction of `cost_spread`.

    Returns:
        Weights of the samples, shape [B, K], and the mean action sequences, shape
        [B, T, A].
    """
    cost, cost_per_field = total_cost(states, cost, ends)
    scale: Tensor | float | None = temperature
    if scale is None:
        stopped = None
        if ends.going is not None:
            stopped = (~ends.going).unflatten(0, (-1, ends.fields)).sum(1)
        scale = temperature_share * cost_spread(cost, cost_per_field, stopped)
    min_cost = cost.amin(dim=1, keepdim=True)
    weights = torch.softmax((min_cost - cost) / scale, dim=1)
    mean = average(sampled.mean, sampled.noise, weights, sampled.low, sampled.high)
    return weights, mean


def total_cost(states: Tensor, cost: Tensor, ends: Ends) -> tuple[Tensor, Tensor]:
    """Add the terminal cost.

    The cost of rollouts on M fields is the CVaR over them. Stopped rollouts have no
    terminal cost.

    Args:
        states: last states of the rollouts, shape [B·M, K, S].
        cost: cost of the rollouts without terminal cost, shape [B·M, K].
        ends: terminal costs.

    Returns:
        Cost of the samples, shape [B, K], and on each field, shape [B, M, K].
    """
    padded_ground, target, grid, objective, fields, level, going, to_go = ends
    ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
    if to_go is None:
        end_cost = terminal_cost(objective, states, ground, target)
    else:
        # All fields of an episode share one map of costs.
        episode_states = states.unflatten(0, (-1, fields)).flatten(1, 2)
        x, y = episode_states[..., 0], episode_states[..., 1]
        path_cost = astar.cost_at(grid, to_go, x, y)
        end_cost = path_cost.view_as(cost) + PENALTY * (ground <= 0)
    if going is not None:
        end_cost = torch.where(going, end_cost, 0)
    cost = cost + end_cost
    cost_per_field = cost.unflatten(0, (-1, fields))
    if fields > 1:
        cost = tail_cost(cost_per_field, level)
    return cost, cost_per_field


def cost_spread(
    cost: Tensor, cost_per_field: Tensor | None = None, stopped: Tensor | None = None
) -> Tensor:
    """Return the mean excess of costs over the minimum: the unit of temperature.

    Samples that pay the penalty of non-free cells for more steps than the best sample,
    over all fields, are excluded. Otherwise the penalty would set the temperature near
    such cells, and all paths over free terrain would have equal weight. Steps are
    counted by the cost on each field in units of the penalty, so the spread of J itself
    should be less than half of the penalty. For the same reason, samples that stop for
    good on more fields than the best sample are excluded.

    Args:
        cost: cost of each sample, shape [B, K].
        cost_per_field: cost on each field, shape [B, M, K]; None for a single field.
        stopped: number of fields on which each sample stops, shape [B, K]; None for 0.

    Returns:
        Mean excess, > 0, shape [B, 1].
    """
    if cost_per_field is None:
        cost_per_field = cost[:, None]
    best = cost.argmin(dim=1, keepdim=True)
    index = best[:, None].expand(-1, cost_per_field.shape[1], -1)
    excess_per_field = cost_per_field - cost_per_field.gather(2, index)
    penalties_per_field = (excess_per_field / PENALTY + 0.5).floor()
    counted = penalties_per_field.sum(1) <= 0
    if stopped is not None:
        counted = counted & (stopped <= stopped.gather(1, best))
    excess = cost - cost.amin(dim=1, keepdim=True)
    total = torch.where(counted, excess, 0).sum(dim=1, keepdim=True)
    spread = total / counted.sum(dim=1, keepdim=True)
    return spread.clamp(min=_MIN_SPREAD)


def average(
    mean: Tensor, noise: Tensor, weights: Tensor, low: Tensor, high: Tensor
) -> Tensor:
    """Return the mean moved by weighted noise, clip(u + Σ w·ε), shape [B, T, A]."""
    offset = (noise * weights[:, None, None]).sum(-1)
    return torch.clamp(mean + offset, low, high)


def drawn_paths(
    problem: Problem,
    state: Tensor,
    updated: Tensor,
    mean: Tensor,
    noise: Tensor,
    weights: Tensor,
) -> dict[str, Tensor]:
    """Return layers of a plan: the updated mean's path, and those of the best samples."""
    count = min(_DRAWN_SAMPLES, weights.shape[1])
    best = weights.topk(count, dim=1).indices
    best_noise = noise[..., best].movedim(2, 0)
    samples = perturb(mean[..., None], best_noise, *problem.action_bounds)
    actions = torch.cat((updated[..., None], samples), dim=3)
    paths = rollout_path(problem, state, actions)
    return {"path": paths[:, 0], "samples": paths[:, 1:]}
