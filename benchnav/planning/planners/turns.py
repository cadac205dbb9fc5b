"""Turns of robots that are steered by an angle and turn only while they drive.

Noise that is independent from step to step turns a bicycle hardly anywhere, since its
steering averages out. So samples about a mean at rest contain no turn to a goal behind
the robot, and each of them leads away from it. A turn is an
action sequence of its own: full steering at full speed for a while, then straight on.
Source: after Trevisan and Alonso-Mora (2024), "Biased-MPPI: Informing sampling-based
model predictive control by fusing ancillary controllers", whose controllers add such
sequences to the samples. Where no turn pays within the horizon, the robot drives a
Dubins
path. Letters in shapes: B episodes, M fields, N cells of a framed map, T horizon steps,
A action dimensions, P primitives.
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

_DURATIONS = 16  # of turns from 0 on, in equal parts of the horizon
_SPACING = 0.5  # of points at which a Dubins path is looked up, in cells


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
    """Choose turns in place of mean action sequences that are no better than standing.

    A turn replaces the mean and is no sample: the average of a turn to the left and one
    to the right is neither. Where none pays within the horizon, since what is gained by
    it comes later, the robot follows a Dubins path until it faces the target; samples
    would only slow it down.

    Args:
        cost_of: gives the cost of action sequences, [B, K], from means [B, T, A] and
            what is added to them, [T, A, K].
        mean: mean action sequences, shape [B, T, A].
        problem: B problems of a robot that is steered by an angle.
        state: states of the robots, shape [B, S].
        target_m: (x, y) to be reached, shape [B, 2].
        ground: M maps of an episode after another, as of `framed_fields`, shape [B·M,
            N].
        following: which robots followed a Dubins path in the last step, bool, shape
            [B].

    Returns:
        Action sequences, shape [B, T, A], and which of them are of Dubins paths, to be
        taken as they are, bool, shape [B].
    """
    robot = problem.robot
    primitives = turning_primitives(robot, mean.shape[1], mean)
    no_offset = torch.zeros_like(primitives[..., :1])
    mean_cost, standing = cost_of(mean, no_offset), cost_of(0 * mean, no_offset)
    stands = (mean_cost >= standing)[:, 0]
    if mean.device.type == "cpu" and not bool(
        (stands | following).any()
    ):  # elsewhere to ask would wait for the device
        return mean, following
    turn_cost, best = cost_of(0 * mean, primitives).min(dim=1)
    pays = stands & (turn_cost < standing[:, 0])
    path, turns = follow_dubins(problem, state, target_m, ground, mean.shape[1])
    follows = turns & (following | (stands & ~pays))
    turn = torch.where(follows[:, None, None], path, primitives.movedim(2, 0)[best])
    return torch.where((pays | follows)[:, None, None], turn, mean), follows


def follow_dubins(
    problem: Problem, state: Tensor, target_m: Tensor, ground: Tensor, horizon: int
) -> tuple[Tensor, Tensor]:
    """Return actions at full speed along the shortest path on which the robot drives
    forward.

    It begins to the side of the target or, where that way is not clear, to the other. A
    way is clear that keeps to free ground which does not immobilise, as far as the
    horizon leads where λ is 1.

    Args:
        problem: B problems of a robot that is steered by an angle.
        state: states of the robots, shape [B, S].
        target_m: (x, y) to be reached, shape [B, 2].
        ground: M maps of an episode after another, as of `framed_fields`, shape [B·M,
            N].
        horizon: steps T.

    Returns:
        Action sequences, shape [B, T, A], and whether one of both ways is clear and
        does not lead straight on, bool, shape [B].
    """
    robot = problem.robot
    low, high = problem.action_bounds
    speed, steering = (robot.action_names.index(name) for name in (SPEED, STEERING))
    extremes = torch.zeros_like(torch.stack((low, high)))
    extremes[:, speed], extremes[:, steering] = (
        high[speed],
        torch.stack((low[steering], high[steering])),
    )
    before = state[:, None].expand(-1, 2, -1)
    motion = (
        robot(
            before, extremes.expand(len(state), -1, -1), torch.ones_like(before[..., 0])
        )
        - before
    )
    step_m, turned = (
        torch.hypot(motion[..., 0], motion[..., 1]).amin(dim=1),
        motion[..., 2].abs().amin(dim=1),
    )
    can_turn = (step_m > 0) & (turned > 0)
    radius = torch.where(can_turn, step_m / turned, 1.0)

    near = dubins_segments_to_point(state[:, :3], target_m, radius)
    far = dubins_segments_to_point(state[:, :3], target_m, radius, far_side=True)
    reach_m = robot.top_speed_mps * horizon * problem.dt_s
    is_clear = [
        _is_clear(problem, state, segments, ground, reach_m) for segments in (near, far)
    ]
    curvature, length = (
        torch.where(is_clear[0][:, None], one, other)
        for one, other in zip(near, far, strict=True)
    )

    own_ground = problem.grid.lookup(
        ground, *state[:, :2].repeat_interleave(len(ground) // len(state), 0).unbind(-1)
    )
    traversability = motion_traversability(
        own_ground, problem.task.rules.min_traversability
    )
    step_m = step_m * traversability.unflatten(0, (len(state), -1)).mean(dim=1)
    along = torch.arange(horizon + 1, device=state.device) * step_m[:, None]
    first, second = length[:, :1], length[:, 1:]
    heading = curvature[:, :1] * along.minimum(first) + curvature[:, 1:] * (
        along - first
    ).clamp(min=0).minimum(second)
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
    ahead = (curvature * length).abs().sum(dim=1) <= turned
    return actions, can_turn & ~ahead & (is_clear[0] | is_clear[1])


def _is_clear(
    problem: Problem,
    state: Tensor,
    segments: tuple[Tensor, Tensor],
    ground: Tensor,
    reach_m: float,
) -> Tensor:
    """Whether ways over segments, as of `dubins_segments_to_point`, keep to ground that
    holds a robot, bool [B].
    """
    grid = problem.grid
    spacing_m = _SPACING * grid.resolution_m
    points = sample_segments(
        state[:, :3], *segments, spacing_m, 1 + math.ceil(reach_m / spacing_m)
    )
    points = points.repeat_interleave(len(ground) // len(state), 0)
    values = grid.lookup(ground, points[..., 0], points[..., 1])
    min_traversability = 0.0 if problem.immobile is None else problem.immobile.below
    firm = (
        predicted_traversability(values).unflatten(0, (len(state), -1)).mean(dim=1)
        >= min_traversability
    )
    return firm.all(dim=1) & (values > 0).unflatten(0, (len(state), -1)).flatten(1).all(
        dim=1
    )


def turning_primitives(robot: Robot, horizon: int, like: Tensor) -> Tensor:
    """Return turns to both sides, forward and, where the robot can reverse, backward
    and backward then forward.

    Args:
        robot: steered by an angle.
        horizon: steps T.
        like: any tensor of the dtype and device.

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
