"""What a robot senses on its way, which its planner is told at each time step.

Before it sets out it sees the whole map: an `Observation` (`benchnav.core.terrain`), of which a model makes the
prediction that a `Problem` holds. On its way it knows where it is, and the λ of the ground that it has just met.
A `Step` is filled in `benchnav.eval.run.rollout`. Letters in shapes: B episodes, S state dimensions.
"""

from dataclasses import dataclass

from torch import Tensor

from benchnav.core.batch import Batch


@dataclass(frozen=True, kw_only=True)
class Step(Batch):
    """What a planner is told at each step.

    Args:
        state: where the robots are, shape [B, S].
        traversability: the λ that each met in the last step, NaN at first, shape [B].
        time_s: time since the episodes began.
        draw: what is planned will be drawn; a planner may leave the layers of its `Plan` out otherwise.
    """

    state: Tensor
    traversability: Tensor
    time_s: float
    draw: bool = False
