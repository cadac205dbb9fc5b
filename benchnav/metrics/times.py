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
    meaning = "share of episodes that reached the goal"


class TotalTime(Metric):
    """T_total: time to the goal, and the time budget T for a failure."""

    name = words = "T_total"
    column = "total_time_s"
    suffix = "_s"
    unit = "s"
    better = "lower"
    meaning = "time to the goal, a failure counted as the time budget T"
    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return T_total in seconds."""
        return episode.end_time_s if episode.success else episode.time_budget_s


class EndTime(Recorded):
    """When the episode ended."""

    name = "end_time"
    column = "end_time_s"
    suffix = "_s"
    unit = "s"
    meaning = "time at which the episode ended"


class ReferenceTime(Recorded):
    """The dataset's reference time of the map."""

    name = "reference_time"
    column = "reference_time_s"
    suffix = "_s"
    unit = "s"
    meaning = "least travel time over the grid at 1 m/s, of the dataset"


class TimeRatio(Metric):
    """Time of a success over the reference time at the robot's top speed."""

    name = column = "time_ratio"
    better = "lower"
    meaning = "time of a success over the reference time at the robot's top speed"
    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return the ratio; NaN for a failure."""
        return (
            episode.end_time_s / episode.reference_at_top_speed_s
            if episode.success
            else math.nan
        )


class Score(Metric):
    """BARN's score: OT over the time, kept within 2 OT and 8 OT; 0 for a failure.

    OT is half the reference time at the robot's top speed, so that arriving in that
    time is the best.
    """

    name = column = "score"
    better = "higher"
    meaning = (
        "BARN's: OT / clip(time, 2 OT, 8 OT), OT half the reference time at "
        "top "
        "speed; 0 for failures"
    )
    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return the score, in [0, 0.5]."""
        if not episode.success:
            return 0.0
        optimal_s = episode.reference_at_top_speed_s / 2
        return optimal_s / min(max(episode.end_time_s, 2 * optimal_s), 8 * optimal_s)
