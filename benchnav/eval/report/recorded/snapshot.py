"""An episode at one moment, with all that the figure of trajectories shows of it.

Letters in shapes: N steps, H×W cells.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from benchnav.eval.report.recorded.drawn_plan import DrawnPlan

# About half-way for most episodes; the paper shows 25 s, when robots here have mostly arrived.
SNAPSHOT_S = 15.0


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """One panel of the trajectory figure.

    Args:
        about: `condition`, its labels, `seed`, `realisation`, `map` and `outcome`, as text.
        rgb: uint8, shape [3, H, W].
        predicted: λ̂, the map the planner was given, shape [H, W].
        free: S_free, bool, shape [H, W].
        field: λ as it was through the episode, shape [H, W]; None where it was resampled.
        soft: ground with soft spots that do not show, bool, shape [H, W].
        immobilising: cells of the field that immobilise a robot, bool, shape [H, W].
        extent_m: size of the map along x and y, shape [2].
        goal_m: (x, y).
        dt_s: time step.
        track: driven positions to the end, shape [N + 1, 2].
        traversability: observed λ, shape [N].
        plan: what was planned at that moment, or last before it.
    """

    about: Mapping[str, str]
    rgb: np.ndarray
    predicted: np.ndarray
    free: np.ndarray
    field: np.ndarray | None
    soft: np.ndarray
    immobilising: np.ndarray
    extent_m: np.ndarray
    goal_m: np.ndarray
    dt_s: float
    track: np.ndarray
    traversability: np.ndarray
    plan: DrawnPlan

    @property
    def now(self) -> int:
        """Index into `track` of the moment."""
        return min(self.plan.step, len(self.track) - 1)

    @property
    def time_s(self) -> float:
        """The moment."""
        return self.now * self.dt_s
