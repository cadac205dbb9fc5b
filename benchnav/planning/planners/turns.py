"""Turning manoeuvres of robots that are steered by an angle.

Noise that is independent from step to step hardly turns a bicycle, since the steering
angles average out. If the goal is behind a standing robot, no sample then turns to the
goal, and all samples lead away from it. Turns are therefore separate action sequences:
full steering at full speed for some steps, then straight driving. If no turn is cheaper
than standing within the horizon, the robot follows a Dubins path.

Source: after Trevisan and Alonso-Mora (2024), "Biased-MPPI: Informing sampling-based
model predictive control by fusing ancillary controllers", whose controllers add such
sequences to the samples. Letters in shapes: B episodes, M fields, N cells of a padded
map, T horizon steps, S state and A action dimensions, P primitives.
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

_DURATIONS = 16  # A turn lasts for 0, 1, … or 16 sixteenths of the horizon.
_SPACING_CELLS = 0.5  # distance between the checked points of a Dubins path, in cells


def is_steered(robot: Robot) -> bool:
    """Return whether the actions of a robot include a speed and a steering angle."""
    return {SPEED, STEERING} <= set(robot.action_names)


def choose(
    cost_of: Callable[[Tensor, Tensor], Tensor],
    mean: Tensor,
    problem: Problem,
    state: Tensor,
    target_m: Tensor,
    ground: Tensor,
    was_on_dubins_path: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return mean action sequences, or turns if the mean costs no less than standing.

    A turn replaces the mean and is not a sample, since the average of a left turn and a
    right turn is no turn. If no turn costs less than standing within the horizon, the
    robot follows a Dubins path until it faces the target. Samples would only slow this
    turn.

    Args:
        cost_of: function that returns the costs [B, K] of action sequences, from means
            [B, T, A] and offsets that are added to each mean, [T, A, K].
        mean: mean action sequences, shape [B, T, A].
        problem: B problems of a robot that is steered by an angle.
        state: states of the robots, shape [B, S].
        target_m: target (x, y) in metres, shape [B, 2].
        ground: padded maps, M for each episode, as in `pad_fields`, shape [B·M, N].
        was_on_dubins_path: mask of robots that followed a Dubins path in the last step,
            bool, shape [B].

    Returns:
        Action sequences, shape [B, T, A], and a mask of robots that follow a Dubins
        path, bool, shape [B]. Their action sequences must not be changed.
    """
    horizon = mean.shape[1]
    primitives = turning_primitives(problem.robot, horizon, mean)
    no_offset = torch.zeros_like(primitives[..., :1])
    mean_cost = cost_of(mean, no_offset)
    standing = 0 * mean
    standing_cost = cost_of(standing, no_offset)
    is_no_better = (mean_cost >= standing_cost)[:, 0]
    # On a GPU, this test would have to wait for the result of the comparison.
    if mean.device.type == "cpu":
        needs_turn = is_no_better | was_on_dubins_path
        if not bool(needs_turn.any()):
            return mean, was_on_dubins_path
    turn_cost, best = cost_of(standing, primitives).min(dim=1)
    is_turn_cheaper = is_no_better & (turn_cost < standing_cost[:, 0])
    path, has_path = follow_dubins(problem, state, target_m, ground, horizon)
    on_dubins_path = has_path & (was_on_dubins_path | (is_no_better & ~is_turn_cheaper))
    best_turn = primitives.movedim(2, 0)[best]
    turn = torch.where(on_dubins_path[:, None, None], path, best_turn)
    is_replaced = (is_turn_cheaper | on_dubins_path)[:, None, None]
    return torch.where(is_replaced, turn, mean), on_dubins_path


def follow_dubins(
    problem: Problem, state: Tensor, target_m: Tensor, ground: Tensor, horizon: int
) -> tuple[Tensor, Tensor]:
    """Return actions at full speed along the shortest forward path to a target.

    The path first turns toward the target or, if that path is not clear, away from it.
    A path is clear if it crosses only free cells that do not immobilise a robot. Its
    checked length is the distance that the robot drives within the horizon at λ = 1.

    Args:
        problem: B problems of a robot that is steered by an angle.
        state: states of the robots, shape [B, S].
        target_m: target (x, y) in metres, shape [B, 2].
        ground: padded maps, M for each episode, as in `pad_fields`, shape [B·M, N].
        horizon: number of steps T.

    Returns:
        Action sequences, shape [B, T, A], and a mask of episodes in which one of the
        two paths is clear and the chosen path is not straight, bool, shape [B].
    """
    robot = problem.robot
    low, high = problem.action_bounds
    speed = robot.action_names.index(SPEED)
    steering = robot.action_names.index(STEERING)
    step_m, turn_rad = _full_steering(problem, state)
    can_turn = (step_m > 0) & (turn_rad > 0)
    radius = torch.where(can_turn, step_m / turn_rad, 1.0)

    pose = state[:, :3]
    near = dubins_segments_to_point(pose, target_m, radius)
    far = dubins_segments_to_point(pose, target_m, radius, far_side=True)
    reach_m = robot.top_speed_mps * horizon * problem.dt_s
    near_clear = _is_clear(problem, state, near, ground, reach_m)
    far_clear = _is_clear(problem, state, far, ground, reach_m)
    curvature = torch.where(near_clear[:, None], near[0], far[0])
    length = torch.where(near_clear[:, None], near[1], far[1])

    n_fields = len(ground) // len(state)
    x, y = state[:, :2].repeat_interleave(n_fields, 0).unbind(-1)
    ground_at_robot = problem.grid.lookup(ground, x, y)
    min_traversability = problem.task.rules.min_traversability
    traversability = motion_traversability(ground_at_robot, min_traversability)
    mean_traversability = traversability.unflatten(0, (len(state), -1)).mean(dim=1)
    step_m = step_m * mean_traversability
    along_m = torch.arange(horizon + 1, device=state.device) * step_m[:, None]
    first_m = length[:, :1]
    second_m = length[:, 1:]
    on_first_m = along_m.minimum(first_m)
    on_second_m = (along_m - first_m).clamp(min=0).minimum(second_m)
    heading = curvature[:, :1] * on_first_m + curvature[:, 1:] * on_second_m
    min_step_m = step_m[:, None].clamp(min=1e-9)
    turn_fraction = heading.diff(dim=1) * radius[:, None] / min_step_m
    right_turn = -turn_fraction * low[steering]
    left_turn = turn_fraction * high[steering]
    actions = state.new_zeros(len(state), horizon, len(low))
    actions[..., speed] = high[speed]
    actions[..., steering] = torch.where(turn_fraction < 0, right_turn, left_turn)
    is_straight = (curvature * length).abs().sum(dim=1) <= turn_rad
    return actions, can_turn & ~is_straight & (near_clear | far_clear)


def _full_steering(problem: Problem, state: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance and the turn of a step with full steering at λ = 1.

    Each is the minimum over a step to the right and a step to the left.

    Returns:
        Distance in metres and turn in radians, each of shape [B].
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
    turn_rad = motion[..., 2].abs().amin(dim=1)
    return step_m, turn_rad


def _is_clear(
    problem: Problem,
    state: Tensor,
    segments: tuple[Tensor, Tensor],
    ground: Tensor,
    reach_m: float,
) -> Tensor:
    """Return a mask of paths on free cells that do not immobilise a robot, bool, [B].

    Args:
        problem: B problems.
        state: states of the robots, shape [B, S].
        segments: paths, as returned by `dubins_segments_to_point`.
        ground: padded maps, M for each episode, shape [B·M, N].
        reach_m: checked length of the paths in metres.
    """
    grid = problem.grid
    spacing_m = _SPACING_CELLS * grid.resolution_m
    count = 1 + math.ceil(reach_m / spacing_m)
    points = sample_segments(state[:, :3], *segments, spacing_m, count)
    points = points.repeat_interleave(len(ground) // len(state), 0)
    values = grid.lookup(ground, points[..., 0], points[..., 1])
    min_traversability = 0.0 if problem.immobile is None else problem.immobile.below
    by_field = (len(state), -1)
    mean = predicted_traversability(values).unflatten(0, by_field).mean(dim=1)
    is_firm = (mean >= min_traversability).all(dim=1)
    is_free = (values > 0).unflatten(0, by_field).flatten(1)
    return is_firm & is_free.all(dim=1)


def turning_primitives(robot: Robot, horizon: int, like: Tensor) -> Tensor:
    """Return turns to both sides, each followed by straight driving.

    A robot turns and drives forward. A robot that can reverse also turns and drives
    backward, or turns backward and then drives forward.

    Args:
        robot: robot that is steered by an angle.
        horizon: number of steps T.
        like: tensor with the dtype and device of the result.

    Returns:
        Action sequences within the bounds, shape [T, A, P].
    """
    names = tuple(robot.action_names)
    speed = names.index(SPEED)
    steering = names.index(STEERING)
    low = robot.action_low
    high = robot.action_high
    forward = max(high[speed], 0.0)
    backward = min(low[speed], 0.0)
    gears = [(forward, forward)]
    if backward < 0:
        gears += [(backward, backward), (backward, forward)]
    step = torch.arange(horizon, device=like.device)[:, None]
    part = torch.arange(_DURATIONS + 1, device=like.device)
    turns = step * _DURATIONS < part * horizon  # [T, durations]
    straight = like.new_zeros(horizon, len(names), _DURATIONS + 1)
    primitives = []
    for first_speed, second_speed in gears:
        for angle in (low[steering], high[steering]):
            actions = straight.clone()
            actions[:, speed] = torch.where(turns, first_speed, second_speed)
            actions[:, steering] = torch.where(turns, angle, 0.0)
            primitives.append(actions)
    return torch.cat(primitives, dim=2)
