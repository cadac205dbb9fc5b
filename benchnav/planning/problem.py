"""The navigation problem that a planner is given (paper, equation 2).

It holds the *predicted* traversability λ̂ alone: the truth stays with the simulation. Letters in
shapes: B episodes, H×W cells, S state and A action dimensions.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.planning.dynamics import Dynamics
from benchnav.planning.objective import Objective
from benchnav.terrain import Grid


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A batch of navigation problems on maps of one grid.

    Args:
        grid: size and resolution of the maps.
        elevation_m: shape [B, H, W].
        traversability: λ̂, the risk setting's map, in [0, 1], shape [B, H, W].
        dynamics: F with its action bounds and time step.
        objective: J.
        start: initial states, shape [B, S].
        goal_m: (x, y) of the goals, shape [B, 2].
        stuck_threshold: λ_stuck; S_free is where λ̂ exceeds it.
        goal_radius_m: a robot this near has arrived.
        time_budget_s: T.
    """

    grid: Grid
    elevation_m: Tensor
    traversability: Tensor
    dynamics: Dynamics
    objective: Objective
    start: Tensor
    goal_m: Tensor
    stuck_threshold: float = 0.3
    goal_radius_m: float = 1.0
    time_budget_s: float = 100.0

    def __post_init__(self) -> None:
        """Checks that the batch is one batch."""
        batch = self.start.shape[0]
        expected = {
            "elevation_m": (batch, *self.grid.shape),
            "traversability": (batch, *self.grid.shape),
            "goal_m": (batch, 2),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ConfigError(f"Expected `{name}` of shape {list(shape)}, got {list(value.shape)}.")

    def __len__(self) -> int:
        """Number of episodes B."""
        return self.start.shape[0]

    @property
    def dt_s(self) -> float:
        """Time step of the dynamics."""
        return self.dynamics.dt_s

    @property
    def free(self) -> Tensor:
        """S_free, bool, shape [B, H, W]."""
        return self.traversability > self.stuck_threshold

    @cached_property
    def padded_traversability(self) -> Tensor:
        """λ̂ framed for lookups; 0 off the map, so that outside is not free."""
        return self.grid.pad(self.traversability, outside=0.0)

    def traversability_at(self, state: Tensor) -> Tensor:
        """λ̂ where the robot stands, shape of `state` [B, *K, S] without the last dimension."""
        return self.grid.lookup(self.padded_traversability, state[..., 0], state[..., 1])

    def select(self, members: Tensor) -> "Problem":
        """Keeps some episodes of the batch.

        Args:
            members: indices, shape [M].
        """
        return replace(
            self,
            elevation_m=self.elevation_m[members],
            traversability=self.traversability[members],
            start=self.start[members],
            goal_m=self.goal_m[members],
        )


def heading_to(position_m: Tensor, goal_m: Tensor) -> Tensor:
    """Initial states (x, y, θ) that look at the goal, shape [B, 3], from positions [B, 2]."""
    offset = goal_m - position_m
    return torch.cat((position_m, torch.atan2(offset[:, 1], offset[:, 0])[:, None]), dim=1)
