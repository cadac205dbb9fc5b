"""What the draw of λ was like: how many were rejected before it, and how fast a robot
could have reached the goal.
"""

from benchnav.metrics.base import Recorded


class RejectedDraws(Recorded):
    """Draws of λ that were rejected."""

    name = column = "rejected_draws"
    meaning = (
        "draws of λ that were rejected because no feasible path joined start and goal"
    )


class LowerBound(Recorded):
    """Time to the goal that no trajectory undercuts."""

    name = "lower_bound"
    column = "lower_bound_s"
    suffix = "_s"
    unit = "s"
    meaning = (
        "time to the goal that no trajectory undercuts, infinite where none arrives; "
        "of planners that are given λ, in "
        "worlds with one λ field an episode"
    )
