"""Metrics of the λ field: rejected draws, and the lower bound of the time to the goal."""

from benchnav.metrics.base import Recorded


class RejectedDraws(Recorded):
    """Number of λ fields that were rejected before the episode's field was drawn."""

    name = column = "rejected_draws"
    meaning = (
        "number of λ fields that were rejected because no feasible path connected "
        "start and goal"
    )


class LowerBound(Recorded):
    """Lower bound of the time to the goal."""

    name = "lower_bound"
    column = "lower_bound_s"
    suffix = "_s"
    unit = "s"
    meaning = (
        "lower bound of the time to the goal, infinite if the goal is unreachable; only "
        "for planners that receive the true λ, in worlds with one λ field per episode"
    )
