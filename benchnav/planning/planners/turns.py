"""Turning manoeuvres of robots that are steered by an angle.

Noise that is independent from step to step hardly turns a bicycle, since its steering
averages out. Samples about a mean at rest then contain no turn to a goal behind the
robot, and all of them lead away from it. A turn is therefore an action sequence of its
own: full steering at full speed for a while, then straight ahead. Source: after
Trevisan and Alonso-Mora (2024), "Biased-MPPI: Informing sampling-based model predictive
control by fusing ancillary controllers", whose controllers add such sequences to the
samples. If no turn pays within the horizon, the robot drives a Dubins path. Letters in
shapes: B episodes, M fields, N cells of a padded map, T horizon steps, A action
dimensions, P primitives.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from benchnav.planning.planners.dubins import dubins_segments_to_point, sample_segments
from benchnav.planning.problem import (
    Problem,
    motion_traversability,
    predicted_traversability,
)
from benchnav.planning.robots import SPEED, STEERING, Robot

_DURATIONS = 16  # of turns from 0 on, equally spaced in the horizon
_SPACING = 0.5  # between points at which a Dubins path is checked, in cells


def is_steered(robot: Robot) -> bool:
    """Return whether a robot is driven by a speed and a steering angle."""
    return {SPEED, STEERING} <= set(robot.action_names)


def choose(
    cost_of: Callable[[Tensor, Tensor], Tensor],
    mean: Tensor,
    problem: Problem,
    state: Tensor,
    target_m: Tensor,
    ground: Tensor,
    following: Tensor,
) -> tuple[Tensor, Tensor]:
    """Replace mean action sequences that are no better than standing by turns.

    A turn replaces the mean instead of being a sample, since the average of a turn to
    the left and one to the right is neither. If none pays within the horizon, since its
    gain comes later, the robot follows a Dubins path until it faces the target; samples
    would only slow it down.

    Args:
        cost_of: returns the cost of action sequences, [B, K], for means [B, T, A] and
            offsets from them, [T, A, K].
        mean: mean action sequences, shape [B, T, A].
        problem: B problems of a robot that is steered by an angle.
        state: states of the robots, shape [B, S].
        target_m: target (x, y) in metres, shape [B, 2].
        ground: padded maps, M for each episode, as in `framed_fields`, shape [B·M, N].
        following: mask of robots that followed a Dubins path in the last step, bool,
            shape [B].

    Returns:
        Action sequences, shape [B, T, A], and a mask of those on Dubins paths, which
        must be used unchanged, bool, shape [B].
    """
    robot = problem.robot
    primitives = turning_primitives(robot, mean.shape[1], mean)
    no_offset = torch.zeros_like(primitives[..., :1])
    mean_cost = cost_of(mean, no_offset)
    standing_cost = cost_of(0 * mean, no_offset)
    stands = (mean_cost >= standing_cost)[:, 0]
    # Only on the CPU: another device would have to synchronise.
    if mean.device.type == "cpu" and not bool((stands | following).any()):
        return mean, following
    turn_cost, best = cost_of(0 * mean, primitives).min(dim=1)
    pays = stands & (turn_cost < standing_cost[:, 0])
    path, turns = follow_dubins(problem, state, target_m, ground, mean.shape[1])
    follows = turns & (following | (stands & ~pays))
    best_turn = primitives.movedim(2, 0)[best]
    turn = torch.where(follows[:, None, None], path, best_turn)
    return torch.where((pays | follows)[:, None, None], turn, mean), follows


def follow_dubins(
    problem: Problem, state: Tensor, target_m: Tensor, ground: Tensor, horizon: int
) -> tuple[Tensor, Tensor]:
    """Return actions at full speed along the shortest forward path to a target.

    The path starts to the side of the target or, if that path is not clear, to the
    other. A path is clear if it keeps to free terrain that does not immobilise, as far
    as the robot gets within the horizon at λ = 1.

    Args:
        problem: B problems of a robot that is steered by an angle.
        state: states of the robots, shape [B, S].
        target_m: target (x, y) in metres, shape [B, 2].
        ground: padded maps, M for each episode, as in `framed_fields`, shape [B·M, N].
        horizon: number of steps T.

    Returns:
        Action sequences, shape [B, T, A], and a mask of episodes in which one of both
        paths is clear and turns, bool, shape [B].
    """
    robot = problem.robot
    low, high = problem.action_bounds
    speed = robot.action_names.index(SPEED)
    steering = robot.action_names.index(STEERING)
    extremes = torch.zeros_like(torch.stack((low, high)))
    extremes[:, speed] = high[speed]
    extremes[:, steering] = torch.stack((low[steering], high[steering]))
    before = state[:, None].expand(-1, 2, -1)
    actions = extremes.expand(len(state), -1, -1)
    motion = robot(before, actions, torch.ones_like(before[..., 0])) - before
    step_m = torch.hypot(motion[..., 0], motion[..., 1]).amin(dim=1)
    turned = motion[..., 2].abs().amin(dim=1)
    can_turn = (step_m > 0) & (turned > 0)
    radius = torch.where(can_turn, step_m / turned, 1.0)

    near = dubins_segments_to_point(state[:, :3], target_m, radius)
    far = dubins_segments_to_point(state[:, :3], target_m, radius, far_side=True)
    reach_m = robot.top_speed_mps * horizon * problem.dt_s
    near_clear, far_clear = (
        _is_clear(problem, state, segments, ground, reach_m) for segments in (near, far)
    )
    curvature = torch.where(near_clear[:, None], near[0], far[0])
    length = torch.where(near_clear[:, None], near[1], far[1])

    n_fields = len(ground) // len(state)
    x, y = state[:, :2].repeat_interleave(n_fields, 0).unbind(-1)
    own_ground = problem.grid.lookup(ground, x, y)
    min_traversability = problem.task.rules.min_traversability
    traversability = motion_traversability(own_ground, min_traversability)
    step_m = step_m * traversability.unflatten(0, (len(state), -1)).mean(dim=1)
    along = torch.arange(horizon + 1, device=state.device) * step_m[:, None]
    first, second = length[:, :1], length[:, 1:]
    on_second = (along - first).clamp(min=0).minimum(second)
    heading = curvature[:, :1] * along.minimum(first) + curvature[:, 1:] * on_second
    turn_fraction = (
        heading.diff(dim=1) * radius[:, None] / step_m[:, None].clamp(min=1e-9)
    )
    actions = state.new_zeros(len(state), horizon, len(low))
    actions[..., speed] = high[speed]
    actions[..., steering] = torch.where(
        turn_fraction < 0,
        -turn_fraction * low[steering],
        turn_fraction * high[steering],
    )
    is_straight = (curvature * length).abs().sum(dim=1) <= turned
    return actions, can_turn & ~is_straight & (near_clear | far_clear)


def _is_clear(
    problem: Problem,
    state: Tensor,
    segments: tuple[Tensor, Tensor],
    ground: Tensor,
    reach_m: float,
) -> Tensor:
    """Return whether paths keep to free terrain that does not immobilise, bool, [B].

    Args:
        problem: B problems.
        state: states of the robots, shape [B, S].
        segments: paths, as returned by `dubins_segments_to_point`.
        ground: padded maps, M for each episode, shape [B·M, N].
        reach_m: length of the paths that is checked.
    """
    grid = problem.grid
    spacing_m = _SPACING * grid.resolution_m
    count = 1 + math.ceil(reach_m / spacing_m)
    points = sample_segments(state[:, :3], *segments, spacing_m, count)
    points = points.repeat_interleave(len(ground) // len(state), 0)
    values = grid.lookup(ground, points[..., 0], points[..., 1])
    min_traversability = 0.0 if problem.immobile is None else problem.immobile.below
    by_field = (len(state), -1)
    mean = predicted_traversability(values).unflatten(0, by_field).mean(dim=1)
    is_firm = (mean >= min_traversability).all(dim=1)
    return is_firm & (values > 0).unflatten(0, by_field).flatten(1).all(dim=1)


def turning_primitives(robot: Robot, horizon: int, like: Tensor) -> Tensor:
    """Return turns to both sides.

    They are forward and, if the robot can reverse, also backward, and backward then
    forward.

    Args:
        robot: robot that is steered by an angle.
        horizon: number of steps T.
        like: tensor of the dtype and device.

    Returns:
        Action sequences within the bounds, shape [T, A, P].
    """
    names = tuple(robot.action_names)
    speed, steering = names.index(SPEED), names.index(STEERING)
    low, high = robot.action_low, robot.action_high
    forward, backward = max(high[speed], 0.0), min(low[speed], 0.0)
    gears = [(forward, forward)]
    if backward < 0:
        gears += [(backward, backward), (backward, forward)]
    step = torch.arange(horizon, device=like.device)[:, None]
    part = torch.arange(_DURATIONS + 1, device=like.device)
    turns = step * _DURATIONS < part * horizon  # [T, durations]
    straight = torch.zeros(
        horizon, len(names), _DURATIONS + 1, dtype=like.dtype, device=like.device
    )
    primitives = []
    for first_speed, second_speed in gears:
        for angle in (low[steering], high[steering]):
            actions = straight.clone()
            actions[:, speed] = torch.where(turns, first_speed, second_speed)
            actions[:, steering] = torch.where(turns, angle, 0.0)
            primitives.append(actions)
    return torch.cat(primitives, dim=2)
