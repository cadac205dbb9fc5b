"""Objectives J: what a planner minimises.

An objective is any object with `stage` and `terminal`. `target` is the goal, or a local planner's
waypoint; traversability is read at the state before the move. Source: paper III-C and IV-A.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class Objective(Protocol):
    """The contract of a cost J, summed over a trajectory. Shapes broadcast over *B."""

    def stage(self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of one step.

        Args:
            state: shape [*B, S], beginning with (x, y, θ).
            action: shape [*B, A].
            traversability: λ̂ at the state, shape [*B].
            target: (x, y) to be reached, shape [*B, 2].

        Returns:
            Shape [*B].
        """
        ...

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of the last state, shape [*B]; arguments as for `stage`."""
        ...


@dataclass(frozen=True, kw_only=True)
class GoalDistance:
    """Distance to the target, and a penalty wherever the robot would be stuck.

    Source: paper IV-A.

    Args:
        stuck_threshold: λ_stuck; at or under it the penalty is due.
        stuck_penalty: added at each such state.
    """

    stuck_threshold: float = 0.3
    stuck_penalty: float = 1e4

    def stage(self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of one step; see `Objective`."""
        return self.terminal(state, traversability, target)

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of the last state; see `Objective`."""
        offset_x, offset_y = state[..., 0] - target[..., 0], state[..., 1] - target[..., 1]
        distance = torch.sqrt(offset_x * offset_x + offset_y * offset_y)
        return distance + self.stuck_penalty * (traversability <= self.stuck_threshold)
