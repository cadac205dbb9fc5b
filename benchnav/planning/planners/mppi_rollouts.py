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
from benchnav.planning.planners.cost_risk import (
    Entrapment,
    tail_cost,
)
from benchnav.planning.planners.noise_bank import (
    Sampled,
    perturb,
    sampled_actions,
)
from benchnav.planning.planners.planner import (
    rollout_path,
)
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
"""Those of `advance_entrapped`: states, cost, dwell_steps, mean, padded_ground, target,
goal, steps_left.
"""
_DRAWN_SAMPLES = 40
_MIN_SPREAD = 1e-30  # if all samples cost the same, all have the same weight


def control_cost(mean: Tensor, noise: Tensor, scale: Tensor) -> Tensor:
    """Return the information-theoretic control cost uᵀΣ⁻¹ε.

    Args:
        mean: mean action sequences u, shape [B, T, A].
        noise: unclipped noise ε, shape [T, A, K].
        scale: standard deviations, Σ = diag(scale²), shape [A].

    Returns:
        Cost, shape [B, K].
    """
    return torch.einsum("bta,tak->bk", mean / scale**2, noise)


class Dwell(NamedTuple):
    """Dwell times of robots on immobilising terrain.

    Args:
        dwell_steps: consecutive steps, shape [B].
        time_s: time since the start in seconds.
    """

    dwell_steps: Tensor
    time_s: float


class Ends(NamedTuple):
    """Terminal costs of rollouts.

    Args:
        padded_ground: padded maps, M for each episode in turn, shape [B·M, N].
        target: target (x, y), shape [B·M, 1, 2].
        grid: size and resolution of the maps.
        objective: J.
        fields: M.
        level: α of the CVaR over fields.
        going: mask of rollouts that have not stopped, bool, shape [B·M, K]; None if
            none stops.
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
        noise: offsets of every mean, clipped to the action bounds, shape [T, A, K].
        target_m: targets (x, y) in metres, shape [B, 2].
        advance: `advance_chunk`, with `dwell` `advance_entrapped`, or the same
            compiled.
        ground: padded maps, M for each episode, as in `framed_fields`, shape [B·M, N];
            None for λ̂.
        dwell: dwell times on immobilising terrain; None without entrapment.

    Returns:
        The last states, shape [B·M, K, S], the cost without terminal cost, shape
        [B·M, K], and, with `dwell`, a mask of those that have not stopped, bool.
    """
    ground = problem.padded_ground if ground is None else ground
    count = len(ground) // len(problem)
    state = state.repeat_interleave(count, 0)
    mean = mean.repeat_interleave(count, 0)
    target_m = target_m.repeat_interleave(count, 0)
    states = component_wise(state[:, None].expand(-1, noise.shape[2], -1))
    # Contiguous, as all arguments: another layout would be compiled again.
    target = target_m[:, None].contiguous()
    cost = state.new_zeros(states.shape[:2])
    horizon = mean.shape[1]
    chunks = [
        slice(begin, min(begin + _CHUNK_STEPS, horizon))
        for begin in range(0, horizon, _CHUNK_STEPS)
    ]
    parts = [
        Sampled(mean[:, chunk].contiguous(), noise[chunk], *problem.action_bounds)
        for chunk in chunks
    ]
    dynamics = problem.dynamics
    if dwell is None or problem.immobile is None:
        for sampled in parts:
            states, cost = advance(states, cost, sampled, ground, target, dynamics)
        return states, cost, None
    max_steps = steps_in(problem.immobile.for_s, problem.dt_s)
    dwell_steps = dwell.dwell_steps.repeat_interleave(count, 0)[:, None]
    dwell_steps = dwell_steps.expand_as(cost).clamp(max=max_steps - 1).contiguous()
    steps_left = (
        ((problem.time_budget_s - dwell.time_s) / problem.dt_s).round().to(state)
    )
    steps_left = steps_left.repeat_interleave(count, 0)[:, None]
    goal = problem.goal_m.repeat_interleave(count, 0)[:, None].contiguous()
    for chunk, sampled in zip(chunks, parts, strict=True):
        rules = Entrapment(
            goal,
            steps_left - chunk.start,
            problem.goal_radius_m,
            problem.immobile.below,
            max_steps,
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
    """Roll out samples over a chunk of the horizon, and add up their costs.

    Arguments are parts of a problem.
    """
    grid, robot, objective, min_traversability = dynamics
    for step in range(sampled.mean.shape[1]):
        action = sampled_actions(sampled, step)
        ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
        cost = cost + stage_cost(objective, states, action, ground, target)
        states = robot(
            states, action, motion_traversability(ground, min_traversability)
        )
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
    weights = torch.softmax((cost.amin(dim=1, keepdim=True) - cost) / scale, dim=1)
    mean = average(sampled.mean, sampled.noise, weights, sampled.low, sampled.high)
    return weights, mean


def total_cost(states: Tensor, cost: Tensor, ends: Ends) -> tuple[Tensor, Tensor]:
    """Add the terminal cost.

    The cost of rollouts on M fields is the CVaR over them. Stopped rollouts have no
    terminal cost.

    Returns:
        Cost of the samples, shape [B, K], and on each field, shape [B, M, K].
    """
    padded_ground, target, grid, objective, fields, level, going, to_go = ends
    ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
    if to_go is None:
        last = terminal_cost(objective, states, ground, target)
    else:
        # All fields of an episode share one map of costs.
        of_episode = states.unflatten(0, (-1, fields)).flatten(1, 2)
        paths = astar.cost_at(grid, to_go, of_episode[..., 0], of_episode[..., 1])
        last = paths.view_as(cost) + PENALTY * (ground <= 0)
    cost = cost + (last if going is None else torch.where(going, last, 0))
    cost_per_field = cost.unflatten(0, (-1, fields))
    return tail_cost(cost_per_field, level) if fields > 1 else cost, cost_per_field


def cost_spread(
    cost: Tensor, cost_per_field: Tensor | None = None, stopped: Tensor | None = None
) -> Tensor:
    """Return the mean excess of costs over the minimum, the unit of the relative
    temperature.

    Samples that pay the penalty of non-free cells for more steps than the best sample,
    over all fields, are left out. Otherwise the temperature near such cells would be
    that of the penalty, and all paths over free terrain would have equal weight. Steps
    are counted by the cost on each field in units of the penalty, so J itself should
    spread by less than half of it. For the same reason, samples that stop for good on
    more fields than the best are left out.

    Args:
        cost: cost of each sample, shape [B, K].
        cost_per_field: cost on each field, shape [B, M, K]; None for a single field.
        stopped: number of fields on which a sample stops, shape [B, K]; None for 0.

    Returns:
        Mean excess, > 0, shape [B, 1].
    """
    if cost_per_field is None:
        cost_per_field = cost[:, None]
    best = cost.argmin(dim=1, keepdim=True)
    index = best[:, None].expand(-1, cost_per_field.shape[1], -1)
    excess_per_field = cost_per_field - cost_per_field.gather(2, index)
    counted = (excess_per_field / PENALTY + 0.5).floor().sum(1) <= 0
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
    return torch.clamp(mean + (noise * weights[:, None, None]).sum(-1), low, high)


def drawn_paths(
    problem: Problem,
    state: Tensor,
    updated: Tensor,
    mean: Tensor,
    noise: Tensor,
    weights: Tensor,
) -> dict[str, Tensor]:
    """Return the path of the updated mean, and those of the best samples."""
    best = weights.topk(min(_DRAWN_SAMPLES, weights.shape[1]), dim=1).indices
    best_noise = noise[..., best].movedim(2, 0)
    samples = perturb(mean[..., None], best_noise, *problem.action_bounds)
    actions = torch.cat((updated[..., None], samples), dim=3)
    paths = rollout_path(problem, state, actions)
    return {"path": paths[:, 0], "samples": paths[:, 1:]}
