"""Metrics of planning time: the wall time of a batch divided by its number of episodes."""

import numpy as np

from benchnav.metrics.base import Episode, Metric


class _LaterSteps(Metric):
    """A percentile of an episode's planning times, from the second step on.

    Attributes:
        percent: percentile, in [0, 100].
    """

    unit = "ms"
    better = "lower"
    percent: int
    min_steps = 2

    def compute(self, episode: Episode) -> float:
        """Return the percentile in milliseconds."""
        return float(np.percentile(1e3 * episode.planning_s[1:], self.percent))


class PlanningTime(_LaterSteps):
    """Median planning time of a step."""

    name = "planning_time"
    column = "planning_ms"
    percent = 50
    meaning = (
        "median planning time per step, from the second step on, where the time of a "
        "batch is divided by its number of episodes"
    )


class HighPlanningTime(_LaterSteps):
    """95th percentile of the planning time of a step."""

    name = "planning_time_p95"
    column = "planning_ms_p95"
    percent = 95
    meaning = (
        "95th percentile of the planning time per step, from the second step on, where "
        "the time of a batch is divided by its number of episodes"
    )


class StartTime(Metric):
    """Time of preparation, compilation and the first step."""

    name = "planning_start"
    column = "planning_start_ms"
    unit = "ms"
    better = "lower"
    meaning = (
        "time of preparation, compilation and the first step, where the time of a batch "
        "is divided by its number of episodes"
    )

    def compute(self, episode: Episode) -> float:
        """Return the time in milliseconds."""
        return 1e3 * episode.preparing_s + float(1e3 * episode.planning_s[0])
