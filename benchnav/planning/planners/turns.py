"""Turning primitives: action sequences that turn a robot that is steered by an angle.

Noise that is independent from step to step turns a bicycle hardly anywhere, since its steering averages out. So samples
about a mean at rest contain no turn to a goal behind the robot, and each of them leads away from it. A turn is an
action sequence of its own: full steering at full speed for a while, then straight on. Source: after Trevisan and
Alonso-Mora (2024), "Biased-MPPI: Informing sampling-based model predictive control by fusing ancillary controllers",
whose controllers add such sequences to the samples. Letters in shapes: T horizon steps, A action dimensions, P
primitives.
"""

import torch
from torch import Tensor

from benchnav.planning.robots import SPEED, STEERING, Robot

_DURATIONS = 16  # of turns from 0 on, in equal parts of the horizon
TURN_HORIZONS = 2  # of MPPI, over which turns are compared


def is_steered(robot: Robot) -> bool:
    """Return whether a robot is driven by a speed and a steering angle."""
    return {SPEED, STEERING} <= set(robot.action_names)


def turning_primitives(robot: Robot, horizon: int, like: Tensor) -> Tensor | None:
    """Return turns to both sides, forward and, where the robot can reverse, backward and backward then forward.

    Args:
        robot: any robot.
        horizon: steps T.
        like: any tensor of the dtype and device.

    Returns:
        Action sequences within the bounds, shape [T, A, P]; None for a robot that is not steered by an angle.
    """
    if not is_steered(robot):
        return None
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
