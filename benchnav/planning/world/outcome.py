"""Outcomes of episodes.

Letters in shapes: B episodes, N steps.
"""

from enum import IntEnum

import torch
from torch import Tensor

from benchnav.planning.robots import steps_in

STUCK_WINDOW_S = 10.0
STUCK_DISTANCE_M = 0.5


class Outcome(IntEnum):
    """State or end of an episode. All ends but SUCCESS count as failures."""

    RUNNING = 0
    SUCCESS = 1
    TIMEOUT = 2
    # a timeout on low λ: in its last 10 s the robot was driven and moved under 0.5 m
    STUCK = 3
    OUT_OF_BOUNDS = 4
    PLANNER_FAILURE = 5  # the planner returned `PlanStatus.FAILED`
    # a timeout; in its last 10 s the robot was not driven and moved under 0.5 m
    STALLED = 6
    # the planner raised, exceeded its time limit, or returned an invalid action
    PLANNER_ERROR = 7
    MODEL_ERROR = 8  # the model or risk measure raised, or returned no distribution
    # consecutive time on immobilising terrain exceeded the world's limit
    IMMOBILISED = 9
    SENSOR_ERROR = 10  # the sensor raised, or returned an invalid measurement
    BELIEF_ERROR = 11  # the belief raised, or returned an invalid value


# Outcomes caused by an exception in user code.
ERROR_OUTCOMES = ("planner_error", "model_error", "sensor_error", "belief_error")
FAILURES = tuple(o for o in Outcome if o not in (Outcome.RUNNING, Outcome.SUCCESS))


def tell_standstill(
    outcome: Tensor, steps: Tensor, positions_m: Tensor, driven_m: Tensor, dt_s: float
) -> Tensor:
    """Replace timeouts in which the robot stood by STUCK or STALLED.

    Args:
        outcome: outcomes, int64, shape [B].
        steps: number of steps of each episode, int64, shape [B].
        positions_m: positions (x, y) in metres, ignored after an episode's end, shape
            [B, N + 1, 2].
        driven_m: commanded distance of each step in metres, the distance at λ = 1,
            shape [B, N].
        dt_s: time step in seconds.

    Returns:
        Outcomes, shape [B].
    """
    if driven_m.shape[1] == 0:
        return outcome
    window = steps_in(STUCK_WINDOW_S, dt_s)
    back = torch.arange(-window, 1, device=steps.device)
    index = (steps[:, None] + back).clamp(min=0)
    recent = positions_m.gather(1, index[..., None].expand(-1, -1, 2))
    moved_m = torch.linalg.vector_norm(recent - recent[:, :1], dim=2).amax(dim=1)
    step_indices = steps[:, None] + back[:-1]
    step_m = driven_m.gather(1, step_indices.clamp(min=0))
    driven_total_m = torch.where(step_indices >= 0, step_m, 0.0).sum(dim=1)
    was_driven = driven_total_m >= STUCK_DISTANCE_M
    standing = torch.where(was_driven, Outcome.STUCK, Outcome.STALLED)
    stands = (outcome == Outcome.TIMEOUT) & (moved_m < STUCK_DISTANCE_M)
    return torch.where(stands, standing, outcome)
