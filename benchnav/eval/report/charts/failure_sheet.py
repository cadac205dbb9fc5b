"""The ground that failures are shown on.

Letters in shapes: N episodes, H×W cells.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class FailedGround:
    """The ground of failed episodes of one condition.

    Args:
        predicted: λ̂, the map the planner was given, shape [N, H, W].
        immobilising: cells that immobilise a robot, bool, shape [N, H, W]; false where λ was resampled.
        resolution_m: edge length of a cell.
        goal_m: (x, y), shape [N, 2].
    """

    predicted: np.ndarray
    immobilising: np.ndarray
    resolution_m: float
    goal_m: np.ndarray

    def told(self, places_m: np.ndarray) -> np.ndarray:
        """λ̂ at a place of each episode, (x, y) of shape [N, 2]; NaN outside the map or where there is no place."""
        cells = np.floor(np.nan_to_num(places_m, nan=-1.0) / self.resolution_m).astype(int)
        column, row = cells.T
        height, width = self.predicted.shape[1:]
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        values = self.predicted[np.arange(len(row)), row.clip(0, height - 1), column.clip(0, width - 1)]
        return np.where(inside, values, np.nan)
