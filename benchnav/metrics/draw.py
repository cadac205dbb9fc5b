"""What the draw of λ was like: how many were rejected before it, and how fast a robot could have reached the goal."""

from benchnav.metrics.base import Episode, Metric


class RejectedDraws(Metric):
    """Draws of λ that were rejected."""

    name = column = "rejected_draws"
    meaning = "draws of λ that were rejected because no feasible path joined start and goal"
    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return the count."""
        return episode.rejected_draws


class LowerBound(Metric):
    """Time to the goal that no trajectory undercuts."""

    name = "lower_bound"
    column = "lower_bound_s"
    suffix = "_s"
    unit = "s"
    meaning = (
        "time to the goal that no trajectory undercuts, infinite where none arrives; of planners that are given λ, in "
        "worlds with one λ field an episode"
    )
    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return the time in seconds, infinite if no trajectory reaches the goal; NaN if it was not computed."""
        return episode.lower_bound_s
