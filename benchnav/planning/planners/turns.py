"""Turning primitives: action sequences that turn a robot that is steered by an angle.

Noise that is independent from step to step turns a bicycle hardly anywhere, since its steering averages out. So samples
about a mean at rest contain no turn to a goal behind the robot, and each of them leads away from it. A turn is an
action sequence of its own: full steering at full speed for a while, then straight on. Source: after Trevisan and
Alonso-Mora (2024), "Biased-MPPI: Informing sampling-based model predictive control by fusing ancillary controllers",
whose controllers add such sequences to the samples. Letters in shapes: T horizon steps, A action dimensions, P
primitives.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from benchnav.planning.robots import SPEED, STEERING, Robot

_DURATIONS = 16  # of turns from 0 on, in equal parts of the horizon
TURN_HORIZONS = 2  # of MPPI, over which turns are compared


def is_steered(robot: Robot) -> bool:
    """Return whether a robot is driven by a speed and a steering angle."""
    return {SPEED, STEERING} <= set(robot.action_names)


def choose(cost_of: Callable[[Tensor, Tensor], Tensor], mean: Tensor, robot: Robot) -> Tensor:
    """Choose turns in place of mean action sequences that are no better than standing.

    A turn replaces the mean and is no sample: the average of a turn to the left and one to the right is neither. Where
    none pays within T they are compared over a longer time, since what is gained by a turn comes after it.

    Args:
        cost_of: gives the cost of action sequences, [B, K], from means [B, T, A] and what is added to them, [T, A, K].
        mean: mean action sequences, shape [B, T, A].
        robot: steered by an angle.

    Returns:
        Action sequences, shape [B, T, A].
    """
    horizon = TURN_HORIZONS * mean.shape[1]
    primitives = turning_primitives(robot, horizon, mean)
    rest, short = torch.zeros_like(primitives[..., :1]), slice(mean.shape[1])
    mean_cost, standing = cost_of(mean, rest[short]), cost_of(0 * mean, rest[short])
    stands = (mean_cost >= standing)[:, 0]
    if mean.device.type == "cpu" and not bool(stands.any()):  # elsewhere to ask would wait for the device
        return mean
    goes_on = torch.cat((mean, mean[:, -1:].expand(-1, horizon - mean.shape[1], -1)), dim=1)
    turn_cost = cost_of(0 * mean, primitives[short])
    pays = turn_cost.amin(dim=1, keepdim=True) < standing
    costs = torch.cat((mean_cost, standing, turn_cost), dim=1)
    choices = torch.cat((rest, primitives), dim=2)
    longer = torch.cat((cost_of(goes_on, rest), cost_of(0 * goes_on, choices)), dim=1)
    best = torch.where(pays, costs, longer).argmin(dim=1)
    turn = primitives[short].movedim(2, 0)[(best - 2).clamp(min=0)]
    return torch.where((stands & (best > 1))[:, None, None], turn, mean)


def turning_primitives(robot: Robot, horizon: int, like: Tensor) -> Tensor:
    """Return turns to both sides, forward and, where the robot can reverse, backward and backward then forward.

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
    rest = torch.zeros(horizon, len(names), _DURATIONS + 1, dtype=like.dtype, device=like.device)
    found = []
    for first, then in gears:
        for angle in (low[steering], high[steering]):
            actions = rest.clone()
            actions[:, speed] = torch.where(turns, first, then)
            actions[:, steering] = torch.where(turns, angle, 0.0)
            found.append(actions)
    return torch.cat(found, dim=2)
