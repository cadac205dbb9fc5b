"""A custom metric: length of a drive relative to the straight line.

benchnav-eval run --data stakes-v1 --model stakes-v1 --world stakes --scenarios '[std]' --maps 8 \
    --planners '[straight,astar_dwa]' --metrics '[examples/own_metric.py:Detour,energy:120]' --out runs/metrics
benchnav-eval compare runs/metrics --by risk --metric detour
"""

import math

import numpy as np

from benchnav.metrics import Episode, Metric


class Detour(Metric):
    """Driven length divided by the straight distance to the goal's edge; NaN if failed."""

    name = "detour"
    column = "detour"
    meaning = "length of the driven path over that of the straight line; of successes"
    better = "lower"

    def compute(self, episode: Episode) -> float:
        """Return the ratio of the lengths, about 1 for a straight drive."""
        if not episode.success:
            return math.nan
        driven_m = np.linalg.norm(np.diff(episode.positions_m, axis=0), axis=1).sum()
        straight_m = (
            np.linalg.norm(episode.goal_m - episode.positions_m[0])
            - episode.goal_radius_m
        )
        return float(driven_m / straight_m)
