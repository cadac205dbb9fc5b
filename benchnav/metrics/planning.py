"""Metrics of planning time: wall times of a batch over the number of episodes that it
was for.
"""

import numpy as np

from benchnav.metrics.base import Episode, Metric


class _LaterSteps(Metric):
    """A percentile of the planning times of all steps but the first."""

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
        "planning time of a step of a batch, per episode of it, from the "
        "second "
        "step on: median"
    )


class HighPlanningTime(_LaterSteps):
    """95th percentile of the planning time of a step."""

    name = "planning_time_p95"
    column = "planning_ms_p95"
    percent = 95
    meaning = (
        "planning time of a step of a batch, per episode of it, from the "
        "second "
        "step on: 95th percentile"
    )


class StartTime(Metric):
    """Time of preparing, compiling and the first step."""

    name = "planning_start"
    column = "planning_start_ms"
    unit = "ms"
    better = "lower"
    meaning = (
        "time of preparing, compiling and the first step, per episode of the batch"
    )

    def compute(self, episode: Episode) -> float:
        """Return the time in milliseconds."""
        return 1e3 * episode.preparing_s + float(1e3 * episode.planning_s[0])
