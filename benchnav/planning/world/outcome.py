"""How episodes end.

Letters in shapes: B episodes, N steps.
"""

from enum import IntEnum

import torch
from torch import Tensor

from benchnav.planning.robots import steps_in

STUCK_WINDOW_S = 10.0
STUCK_DISTANCE_M = 0.5


class Outcome(IntEnum):
    """How an episode stands, or how it ended. All but SUCCESS count as failures."""

    RUNNING = 0
    SUCCESS = 1
    TIMEOUT = 2
    # a timeout whose last 10 s drove and moved under 0.5 m: low λ stopped the robot
    STUCK = 3
    OUT_OF_BOUNDS = 4
    PLANNER_FAILURE = 5  # the planner gave up
    # a timeout whose last 10 s did not drive and moved under 0.5 m: the planner stopped
    # it
    STALLED = 6
    PLANNER_ERROR = (
        7  # the planner raised, ran out of time, or returned what no robot can do
    )
    MODEL_ERROR = 8  # the model or the risk measure raised, or gave no distribution
    IMMOBILISED = (
        9  # on ground that immobilises a robot, for as long as the world allows
    )
    SENSOR_ERROR = 10  # the sensor raised, or gave what is none
    BELIEF_ERROR = 11  # the belief raised, or gave what is none


# Outcomes caused by an exception in user code.
ERROR_OUTCOMES = ("planner_error", "model_error", "sensor_error", "belief_error")
FAILURES = tuple(o for o in Outcome if o not in (Outcome.RUNNING, Outcome.SUCCESS))


def tell_standstill(
    outcome: Tensor, steps: Tensor, positions_m: Tensor, driven_m: Tensor, dt_s: float
) -> Tensor:
    """Tells timeouts in which the robot stood: stuck where it drove, stalled where it
    did not.

    Args:
        outcome: shape [B].
        steps: steps that each episode took, int64, shape [B].
        positions_m: shape [B, N + 1, 2], those after an episode's end not looked at.
        driven_m: how far each step would have moved the robot on ground of λ = 1, shape
            [B, N].
        dt_s: time step.

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
    driven_total_m = torch.where(
        step_indices >= 0, driven_m.gather(1, step_indices.clamp(min=0)), 0.0
    ).sum(dim=1)
    standing = torch.where(
        driven_total_m >= STUCK_DISTANCE_M, Outcome.STUCK, Outcome.STALLED
    )
    return torch.where(
        (outcome == Outcome.TIMEOUT) & (moved_m < STUCK_DISTANCE_M), standing, outcome
    )
