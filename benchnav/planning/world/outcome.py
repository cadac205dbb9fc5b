"""Outcomes of episodes.

Letters in shapes: B episodes, N steps.
"""

from enum import IntEnum

import torch
from torch import Tensor

from benchnav.planning.robots import steps_in

STUCK_WINDOW_S = 10.0
"""Time before a timeout in which the robot's motion is measured, in seconds."""
STUCK_DISTANCE_M = 0.5
"""Distance in metres below which the robot stood still in that time."""


class Outcome(IntEnum):
    """Outcome of an episode. All but RUNNING and SUCCESS are failures."""

    RUNNING = 0
    SUCCESS = 1
    TIMEOUT = 2
    # Timeout. In the last 10 s, the actions commanded at least 0.5 m, but the robot
    # moved less than 0.5 m.
    STUCK = 3
    OUT_OF_BOUNDS = 4
    PLANNER_FAILURE = 5  # The planner returned `PlanStatus.FAILED`.
    # Timeout. In the last 10 s, the actions commanded less than 0.5 m, and the robot
    # moved less than 0.5 m.
    STALLED = 6
    # The planner raised an error, exceeded its time limit, or returned an invalid
    # action.
    PLANNER_ERROR = 7
    # The model or risk measure raised an error, or returned an invalid value; or the
    # simulated physics failed.
    MODEL_ERROR = 8
    # The robot was on immobilising terrain for as long as the world allows.
    IMMOBILISED = 9
    SENSOR_ERROR = 10  # The sensor raised an error, or returned an invalid measurement.
    BELIEF_ERROR = 11  # The belief raised an error, or returned an invalid value.
    ROLLOVER = 12  # The robot tipped over.


# Names of the outcomes that an error in user code causes.
ERROR_OUTCOMES = ("planner_error", "model_error", "sensor_error", "belief_error")
FAILURES = tuple(o for o in Outcome if o not in (Outcome.RUNNING, Outcome.SUCCESS))


def classify_standstill(
    outcome: Tensor, steps: Tensor, positions_m: Tensor, driven_m: Tensor, dt_s: float
) -> Tensor:
    """Replace a timeout by STUCK or STALLED if the robot stood still before it.

    Args:
        outcome: outcomes, int64, shape [B].
        steps: number of steps of each episode, int64, shape [B].
        positions_m: positions (x, y) in metres, shape [B, N + 1, 2]; those after an
            episode's end are ignored.
        driven_m: commanded distance of each step in metres, which the robot would drive
            at λ = 1, shape [B, N].
        dt_s: time step in seconds.

    Returns:
        Outcomes, int64, shape [B].
    """
    if driven_m.shape[1] == 0:
        return outcome
    window = steps_in(STUCK_WINDOW_S, dt_s)
    offsets = torch.arange(-window, 1, device=steps.device)
    index = (steps[:, None] + offsets).clamp(min=0)
    recent_m = positions_m.gather(1, index[..., None].expand(-1, -1, 2))
    moved_m = torch.linalg.vector_norm(recent_m - recent_m[:, :1], dim=2).amax(dim=1)
    step_indices = steps[:, None] + offsets[:-1]
    step_m = driven_m.gather(1, step_indices.clamp(min=0))
    driven_total_m = torch.where(step_indices >= 0, step_m, 0.0).sum(dim=1)
    was_driven = driven_total_m >= STUCK_DISTANCE_M
    stuck_or_stalled = torch.where(was_driven, Outcome.STUCK, Outcome.STALLED)
    stood_still = (outcome == Outcome.TIMEOUT) & (moved_m < STUCK_DISTANCE_M)
    return torch.where(stood_still, stuck_or_stalled, outcome)
