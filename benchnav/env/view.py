"""Observations of a policy: a crop that turns with the robot, and a state vector.

`benchnav/OffRoad-v1` and `PolicyPlanner` compute observations by the same function, so
that a policy observes the same in an evaluation as in training. In the robot's frame, x
points ahead and y to the left. A crop is indexed as maps are, [row = y, column = x].
Letters in shapes: B episodes, H×W cells of the map, N×N cells of the crop, S state
dimensions.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.core.grid import Grid
from benchnav.planning.objective import distance

CHANNELS = ("risk", "spread", "rise", "known")
NUMBERS = (
    "goal_distance",
    "goal_cos",
    "goal_sin",
    "observed_traversability",
    "time_left",
)
_POSE = 3  # number of state dimensions that every robot has: x, y, θ


@dataclass(frozen=True, kw_only=True)
class MapKnowledge(Batch):
    """Knowledge of the terrain of B maps.

    Args:
        risk_map: λ̂ under the risk setting, in [0, 1], shape [B, H, W].
        spread: half of the range from the 16 % to the 84 % quantile of λ, in [0, 0.5],
            shape [B, H, W].
        elevation_m: elevation in metres; ignored in unobserved cells, shape [B, H, W].
        seen: mask of observed cells, bool, shape [B, H, W].
    """

    risk_map: Tensor
    spread: Tensor
    elevation_m: Tensor
    seen: Tensor


@dataclass(frozen=True, kw_only=True)
class View:
    """Part of the map that a policy observes.

    Args:
        cells: N, number of rows and of columns of the crop, ≥ 2; a cell of the crop has
            the size of a cell of the map.
        behind: fraction of the crop's length that is behind the robot, in [0, 1); at
            0.5 the robot is in the middle.
    """

    cells: int = 32
    behind: float = 1 / 3

    def __post_init__(self) -> None:
        """Validate the size of the crop and the robot's position in it."""
        is_integer = isinstance(self.cells, int | np.integer)
        is_count = is_integer and not isinstance(self.cells, bool)
        expect(
            is_count and self.cells >= 2,
            f"`crop_cells` to be an integer ≥ 2, got {self.cells!r}.",
        )
        expect(0 <= self.behind < 1, f"`crop_behind` in [0, 1), got {self.behind}.")

    def reach_m(self, grid: Grid) -> float:
        """Return half of the crop's length in metres, which scales observed lengths."""
        return self.cells * grid.resolution_m / 2

    def corners_m(self, grid: Grid, state: Tensor) -> Tensor:
        """Return the corners (x, y) of the crop on the map, in order around it.

        Args:
            grid: grid of the maps.
            state: states of the robots, beginning with (x, y, θ), shape [B, S].

        Returns:
            Positions in metres, shape [B, 4, 2].
        """
        length = 2 * self.reach_m(grid)
        along = torch.tensor([0.0, 1.0, 1.0, 0.0], dtype=state.dtype) - self.behind
        across = torch.tensor([-0.5, -0.5, 0.5, 0.5], dtype=state.dtype)
        ahead = length * along[None]
        to_left = length * across[None]
        positions = _to_map(state, ahead, to_left)
        return torch.stack(positions, dim=-1)

    def crop(self, grid: Grid, knowledge: MapKnowledge, state: Tensor) -> Tensor:
        """Return all channels of the crop, each cell from the map cell at its centre.

        Args:
            grid: grid of the maps.
            knowledge: knowledge of the terrain in B episodes.
            state: states of the robots, beginning with (x, y, θ), shape [B, S].

        Returns:
            `CHANNELS`, float32, shape [B, 4, N, N]; all 0 off the map.
        """
        reach_m = self.reach_m(grid)
        length = 2 * reach_m
        indices = torch.arange(self.cells, dtype=state.dtype, device=state.device)
        fraction = (indices + 0.5) / self.cells
        ahead = length * (fraction - self.behind)[None, None]
        to_left = length * (fraction - 0.5)[None, :, None]
        x, y = _to_map(state[:, None], ahead, to_left)
        inside = grid.contains(x, y)
        row, column = grid.cell_of(x, y)
        cell = (row * grid.width + column).flatten(1)

        def read(values: Tensor) -> Tensor:
            cropped = values.flatten(1).gather(1, cell)
            return cropped.view(x.shape).float()

        episode = torch.arange(len(state), device=state.device)
        robot_row, robot_column = grid.cell_of(state[:, 0], state[:, 1])
        robot_elevation_m = knowledge.elevation_m[episode, robot_row, robot_column]
        rise_m = read(knowledge.elevation_m) - robot_elevation_m[:, None, None]
        rise = (rise_m / reach_m).clamp(-1, 1)
        seen = inside & (read(knowledge.seen) > 0)
        risk = read(knowledge.risk_map)
        spread = 2 * read(knowledge.spread)
        channels = [
            torch.where(inside, risk, 0.0),
            torch.where(inside, spread, 0.0),
            torch.where(seen, rise, 0.0),
            seen.float(),
        ]
        return torch.stack(channels, dim=1)

    def observe(
        self,
        grid: Grid,
        knowledge: MapKnowledge,
        state: Tensor,
        goal_m: Tensor,
        observed: Tensor,
        time_left: Tensor,
    ) -> dict[str, Tensor]:
        """Return the observations of B episodes.

        Args:
            grid: grid of the maps.
            knowledge: knowledge of the terrain.
            state: states of the robots, beginning with (x, y, θ), shape [B, S].
            goal_m: (x, y) of the goals in metres, shape [B, 2].
            observed: λ observed under each robot in the last step; NaN before the first
                step, shape [B].
            time_left: remaining fraction of the time budget, shape [B].

        Returns:
            `crop`, shape [B, 4, N, N], and `state`, shape [B, 5 + S − 3], both float32.
        """
        to_goal = goal_m - state[:, :2]
        azimuth = torch.atan2(to_goal[:, 1], to_goal[:, 0])
        bearing = azimuth - state[:, 2]
        goal_distance = distance(state, goal_m) / self.reach_m(grid)
        numbers = [
            _squash(goal_distance),
            bearing.cos(),
            bearing.sin(),
            torch.where(observed.isnan(), 1.0, observed),
            time_left.clamp(0, 1),
        ]
        numbers = [number.float() for number in numbers]
        common = torch.stack(numbers, dim=1)
        # Velocities, and all other dimensions of the robot's state beyond its pose.
        extra = _squash(state[:, _POSE:]).float()
        vector = torch.cat((common, extra), dim=1)
        return {"crop": self.crop(grid, knowledge, state), "state": vector}


def bounds(states: int) -> tuple[list[float], list[float]]:
    """Return minimum and maximum of the observed state vector.

    Args:
        states: S, number of dimensions of the robot's state.

    Returns:
        Two lists of length 5 + S − 3.
    """
    n_extra = states - _POSE
    minimum = [0.0, -1.0, -1.0, 0.0, 0.0]
    minimum += [-1.0] * n_extra
    maximum = [1.0] * len(minimum)
    return minimum, maximum


def _to_map(state: Tensor, ahead: Tensor, to_left: Tensor) -> tuple[Tensor, Tensor]:
    """Convert positions from the robots' frames to (x, y) on the map, in metres.

    Args:
        state: states of the robots, shape [B, …, S].
        ahead: distance ahead of the robot in metres, of a shape that broadcasts to [B, …].
        to_left: distance to the left of the robot in metres, of the same shape.
    """
    x = state[..., 0, None]
    y = state[..., 1, None]
    heading = state[..., 2, None]
    cos = heading.cos()
    sin = heading.sin()
    x = x + cos * ahead - sin * to_left
    y = y + sin * ahead + cos * to_left
    return x, y


def _squash(value: Tensor) -> Tensor:
    """Return x / (1 + |x|), which maps all numbers to (−1, 1)."""
    return value / (1 + value.abs())
