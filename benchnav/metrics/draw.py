"""Metrics of the λ field: rejected draws, and the lower bound of the time to the goal."""

from benchnav.metrics.base import Recorded


class RejectedDraws(Recorded):
    """Number of λ fields that were rejected before the one of the episode."""

    name = column = "rejected_draws"
    meaning = (
        "draws of λ that were rejected because no feasible path joined start and goal"
    )


class LowerBound(Recorded):
    """Lower bound of the time to the goal."""

    name = "lower_bound"
    column = "lower_bound_s"
    suffix = "_s"
    unit = "s"
    meaning = (
        "lower bound of the time to the goal, infinite if it is unreachable; "
        "of planners that are given λ, in worlds with one λ field per episode"
    )
