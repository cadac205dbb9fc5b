"""Hand-made episodes."""

from typing import Any

import numpy as np

from benchnav.metrics import Episode
from benchnav.planning.robots import Unicycle


def episode(traversability: Any, **changes: Any) -> Episode:
    """A unicycle that is commanded 1 m/s straight ahead in steps of 0.1 s from (2, 3)."""
    met = np.array(traversability, dtype=float)
    steps = len(met)
    track = np.zeros((steps + 1, 3))
    track[:, 0] = 2 + np.concatenate(([0.0], np.cumsum(0.1 * met)))
    track[:, 1] = 3.0
    given: dict[str, Any] = {
        "states": track,
        "actions": np.tile((1.0, 0.0), (steps, 1)),
        "action_names": ("speed_mps", "turn_rate_radps"),
        "speed_mps": np.ones(steps),
        "turn_rate_radps": np.zeros(steps),
        "traversability": met,
        "outcome": "success",
        "dt_s": 0.1,
        "time_budget_s": 50.0,
        "reference_time_s": 2.0,
        "goal_m": np.array([8.0, 3.0]),
        "goal_radius_m": 1.0,
        "stuck_traversability": 0.3,
        "robot": Unicycle(speed_mps=(0.0, 1.0)),
        "planning_s": np.linspace(0.001, 0.001 * steps, steps),
        "preparing_s": 0.5,
    }
    return Episode(**given | changes)
