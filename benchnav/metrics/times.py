"""Metrics of success and time.

Sources: Endo, Honda and Ishigami (2024), IV-A, for success rate and total time; Perille
et al. (2020), "Benchmarking metric ground navigation" (BARN), for the score.
"""

import math

from benchnav.metrics.base import Episode, Metric, Recorded


class Success(Recorded):
    """Whether the robot reached the goal."""

    name = column = "success"
    unit = "points"
    scale = 100
    better = "higher"
    heading = "Succ. [%]"
    meaning = "fraction of episodes that reached the goal"


class TotalTime(Metric):
    """Time to the goal, or the time budget T for a failure."""

    name = words = "T_total"
    column = "total_time_s"
    suffix = "_s"
    unit = "s"
    better = "lower"
    meaning = "time to the goal; failures count as the time budget T"
    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return T_total in seconds."""
        return episode.end_time_s if episode.success else episode.time_budget_s


class EndTime(Recorded):
    """Duration of the episode."""

    name = "end_time"
    column = "end_time_s"
    suffix = "_s"
    unit = "s"
    meaning = "time at which the episode ended"


class ReferenceTime(Recorded):
    """Reference time of the map, from the dataset."""

    name = "reference_time"
    column = "reference_time_s"
    suffix = "_s"
    unit = "s"
    meaning = "minimum travel time over the grid at 1 m/s, from the dataset"


class TimeRatio(Metric):
    """Time of a success divided by the reference time at the robot's top speed."""

    name = column = "time_ratio"
    better = "lower"
    meaning = "time of a success divided by the reference time at the robot's top speed"
    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return the ratio; NaN for a failure."""
        if not episode.success:
            return math.nan
        return episode.end_time_s / episode.reference_at_top_speed_s


class Score(Metric):
    """BARN's score: OT / clip(time, 2 OT, 8 OT); 0 for a failure.

    OT is half the reference time at the robot's top speed, so that a robot which
    reaches the goal in the reference time has the maximum score.
    """

    name = column = "score"
    better = "higher"
    meaning = (
        "BARN's score OT / clip(time, 2 OT, 8 OT), with OT half the reference time at "
        "top speed; 0 for failures"
    )
    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return the score, in [0, 0.5]."""
        if not episode.success:
            return 0.0
        optimal_s = episode.reference_at_top_speed_s / 2
        return optimal_s / min(max(episode.end_time_s, 2 * optimal_s), 8 * optimal_s)
