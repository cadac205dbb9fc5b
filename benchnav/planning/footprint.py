"""Footprints: the contacts of a robot with the terrain, and what planners make of them.

A point robot has no footprint: it meets λ of one cell. A robot with a footprint has
four contacts, two on each side. Letters in shapes: B episodes, H×W cells, *K any
further dimensions.
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from benchnav.core.errors import expect
from benchnav.core.grid import Grid


@dataclass(frozen=True, kw_only=True)
class Footprint:
    """Contacts of a robot: two on each side, the corners of a rectangle.

    Args:
        track_m: distance between the left and the right contacts, in metres.
        wheelbase_m: distance between the front and the rear contacts, in metres.
        ahead_m: distance of the rectangle's centre ahead of the robot's position, in
            metres.
    """

    track_m: float
    wheelbase_m: float
    ahead_m: float = 0.0

    def __post_init__(self) -> None:
        """Validate the lengths."""
        for name in ("track_m", "wheelbase_m"):
            value = getattr(self, name)
            expect(
                0 < value < float("inf"),
                f"`{name}` of a footprint > 0 and finite, got {value}.",
            )
        expect(
            math.isfinite(self.ahead_m),
            f"`ahead_m` of a footprint finite, got {self.ahead_m}.",
        )

    @property
    def radius_m(self) -> float:
        """Largest distance of a contact from the robot's position, in metres."""
        reach_m = self.wheelbase_m / 2 + abs(self.ahead_m)
        return math.hypot(self.track_m / 2, reach_m)

    def contacts(self, state: Tensor) -> Tensor:
        """Return the positions of the contacts.

        Args:
            state: states that begin with (x, y, θ), shape [*B, S].

        Returns:
            Positions (x, y) in metres, shape [*B, 2, 2, 2]: left and right side, front
            and rear contact, coordinates.
        """
        half_m = self.wheelbase_m / 2
        along = state.new_tensor([self.ahead_m + half_m, self.ahead_m - half_m])
        across = state.new_tensor([self.track_m / 2, -self.track_m / 2])[:, None]
        cos = state[..., 2].cos()[..., None, None]
        sin = state[..., 2].sin()[..., None, None]
        x = state[..., 0, None, None] + along * cos - across * sin
        y = state[..., 1, None, None] + along * sin + across * cos
        return torch.stack((x, y), dim=-1)


def minimum_over_footprint(
    values: Tensor, grid: Grid, radius_m: float, outside: float = 0.0
) -> Tensor:
    """Return the minimum of a map over the cells that a robot in each cell may touch.

    These are the cells that a disc around the robot's reference point meets, wherever
    the reference point lies in its cell and whatever the heading is.

    Args:
        values: maps, floating-point or bool, shape [*K, H, W].
        grid: size and resolution of the maps.
        radius_m: radius of the disc in metres; 0 returns the maps unchanged.
        outside: value off the map.

    Returns:
        Minimum of each cell, dtype and shape of `values`.
    """
    offsets = _offsets(radius_m / grid.resolution_m)
    if len(offsets) == 1:
        return values
    margin = max(row for row, _ in offsets)
    is_mask = values.dtype == torch.bool
    padded = torch.nn.functional.pad(values, [margin] * 4, value=outside)
    height, width = grid.shape
    minimum: Tensor | None = None
    for row, column in offsets:
        rows = slice(margin + row, margin + row + height)
        columns = slice(margin + column, margin + column + width)
        shifted = padded[..., rows, columns]
        if minimum is None:
            minimum = shifted.clone()
        elif is_mask:
            minimum &= shifted
        else:
            torch.minimum(minimum, shifted, out=minimum)
    assert minimum is not None
    return minimum


@cache
def _offsets(radius_cells: float) -> tuple[tuple[int, int], ...]:
    """Return the offsets (row, column) of the cells that a disc may meet.

    The centre of the disc may lie anywhere in the cell (0, 0).

    Args:
        radius_cells: radius in cells.
    """
    if radius_cells == 0:
        return ((0, 0),)
    reach = math.ceil(radius_cells)
    steps = range(-reach, reach + 1)
    offsets = []
    for row in steps:
        for column in steps:
            # Distance between the nearest points of the two cells.
            gap = math.hypot(max(abs(row) - 1, 0), max(abs(column) - 1, 0))
            if gap < radius_cells:
                offsets.append((row, column))
    return tuple(offsets)
