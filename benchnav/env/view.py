"""What a policy is given: a crop of what is known, which turns with the robot, and
numbers of robot and goal.

The same function makes the observations of `benchnav/OffRoad-v1` and those of a
`PolicyPlanner`, so that a policy meets in an evaluation what it was trained on. The
robot's frame has x ahead and y to its left; a crop is indexed as maps are, [row = y,
column = x]. Letters in shapes: B episodes, H×W cells of the map, N×N cells of the crop,
S state dimensions.
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
_POSE = 3  # dimensions of a state that every robot has: x, y, θ


@dataclass(frozen=True, kw_only=True)
class Known(Batch):
    """What is known of the ground.

    Args:
        risk_map: λ̂ as the risk setting gives it, in [0, 1], shape [B, H, W].
        spread: half of the range from the 16 % to the 84 % quantile of λ, in [0, 0.5],
            shape [B, H, W].
        elevation_m: of what was seen; of other cells it is not used, shape [B, H, W].
        seen: which cells were seen, bool, shape [B, H, W].
    """

    risk_map: Tensor
    spread: Tensor
    elevation_m: Tensor
    seen: Tensor


@dataclass(frozen=True, kw_only=True)
class View:
    """Which part of the map a policy sees.

    Args:
        cells: N, rows and columns of the crop; its cells have the size of the map's.
        behind: share of the crop's length that is behind the robot: 0.5 has the robot
            in the middle.
    """

    cells: int = 32
    behind: float = 1 / 3

    def __post_init__(self) -> None:
        """Refuses crops that hold nothing, or not the robot."""
        is_count = isinstance(self.cells, int | np.integer) and not isinstance(
            self.cells, bool
        )
        expect(
            is_count and self.cells >= 2,
            f"`crop_cells` as a whole number of at least 2, got {self.cells!r}.",
        )
        expect(0 <= self.behind < 1, f"`crop_behind` in [0, 1), got {self.behind}.")

    def reach_m(self, grid: Grid) -> float:
        """Half of the crop's length, by which lengths are scaled."""
        return self.cells * grid.resolution_m / 2

    def corners_m(self, grid: Grid, state: Tensor) -> Tensor:
        """Corners (x, y) of the crop on the map, in a circle, shape [B, 4, 2]."""
        length = 2 * self.reach_m(grid)
        ahead = torch.tensor([0.0, 1.0, 1.0, 0.0], dtype=state.dtype) - self.behind
        left = torch.tensor([-0.5, -0.5, 0.5, 0.5], dtype=state.dtype)
        return torch.stack(
            _to_map(state, length * ahead[None], length * left[None]), dim=-1
        )

    def crop(self, grid: Grid, known: Known, state: Tensor) -> Tensor:
        """Reads what is known at the centre of each cell of the crop, in the map's cell
        that it lies in.

        Args:
            grid: of the maps.
            known: of B episodes.
            state: beginning with (x, y, θ), shape [B, S].

        Returns:
            `CHANNELS`, float32, shape [B, 4, N, N]; all 0 off the map.
        """
        length = 2 * self.reach_m(grid)
        along = (
            torch.arange(self.cells, dtype=state.dtype, device=state.device) + 0.5
        ) / self.cells
        x, y = _to_map(
            state[:, None],
            length * (along - self.behind)[None, None],
            length * (along - 0.5)[None, :, None],
        )
        inside = grid.contains(x, y)
        row, column = grid.cell_of(x, y)
        cell = (row * grid.width + column).flatten(1)

        def read(values: Tensor) -> Tensor:
            return values.flatten(1).gather(1, cell).view(x.shape).float()

        own = (
            torch.arange(len(state), device=state.device),
            *grid.cell_of(state[:, 0], state[:, 1]),
        )
        rise = (
            read(known.elevation_m) - known.elevation_m[own][:, None, None]
        ) / self.reach_m(grid)
        seen = inside & (read(known.seen) > 0)
        channels = [
            torch.where(inside, read(known.risk_map), 0.0),
            torch.where(inside, 2 * read(known.spread), 0.0),
            torch.where(seen, rise.clamp(-1, 1), 0.0),
            seen.float(),
        ]
        return torch.stack(channels, dim=1)

    def observe(
        self,
        grid: Grid,
        known: Known,
        state: Tensor,
        goal_m: Tensor,
        observed: Tensor,
        time_left: Tensor,
    ) -> dict[str, Tensor]:
        """Makes the observations of B episodes.

        Args:
            grid: of the maps.
            known: of the ground.
            state: where the robots are, shape [B, S].
            goal_m: (x, y) of the goals, shape [B, 2].
            observed: λ that each robot met in the last step, NaN where there was none,
                shape [B].
            time_left: share of the time budget that is left, shape [B].

        Returns:
            `crop`, shape [B, 4, N, N], and `state`, shape [B, 5 + S − 3], both float32.
        """
        to_goal = goal_m - state[:, :2]
        bearing = torch.atan2(to_goal[:, 1], to_goal[:, 0]) - state[:, 2]
        numbers = [
            _squash(distance(state, goal_m) / self.reach_m(grid)),
            bearing.cos(),
            bearing.sin(),
            torch.where(observed.isnan(), 1.0, observed),
            time_left.clamp(0, 1),
        ]
        numbers = [number.float() for number in numbers]
        own = _squash(state[:, _POSE:]).float()
        return {
            "crop": self.crop(grid, known, state),
            "state": torch.cat((torch.stack(numbers, dim=1), own), dim=1),
        }


def bounds(states: int) -> tuple[list[float], list[float]]:
    """Least and greatest values of the numbers of a robot whose state has so many
    dimensions.
    """
    more = states - _POSE
    return [0.0, -1.0, -1.0, 0.0, 0.0, *[-1.0] * more], [1.0] * (len(NUMBERS) + more)


def _to_map(state: Tensor, ahead: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (x, y) on the map of places in the robots' frames; they broadcast to
    [B, *K].
    """
    x, y, heading = (state[..., i, None] for i in range(_POSE))
    cos, sin = heading.cos(), heading.sin()
    return x + cos * ahead - sin * left, y + sin * ahead + cos * left


def _squash(value: Tensor) -> Tensor:
    """Maps all numbers to (−1, 1), those of at least 0 to [0, 1)."""
    return value / (1 + value.abs())
