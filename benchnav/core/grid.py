"""The grid of a map: from positions to cells and back.

Conventions: maps are indexed [row = y, column = x]; cell (i, j) is centred at
((j + ½)·res, (i + ½)·res); a position belongs to the cell it lies in; outside the map
is not free
space. Letters in shapes: B maps, H×W cells.

PyTorch is imported where it is called: making and listing datasets does without.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from benchnav.core.errors import expect

if TYPE_CHECKING:
    from torch import Tensor


MAX_CELLS = 2**28  # of a map; no machine holds its fields


@dataclass(frozen=True)
class Grid:
    """Size and resolution of a map.

    Args:
        height: rows, cells along y.
        width: columns, cells along x.
        resolution_m: edge length of a square cell in metres.
    """

    height: int
    width: int
    resolution_m: float

    def __post_init__(self) -> None:
        """Refuses empty grids and resolutions that are not positive."""
        expect(
            min(self.shape) >= 3,
            f"a grid of at least 3×3 cells, got {self.height}×{self.width}.",
        )
        expect(
            self.height * self.width <= MAX_CELLS,
            f"a map of at most {MAX_CELLS:,} cells, got {self.height}×{self.width}.",
        )
        expect(
            0 < self.resolution_m < float("inf"),
            f"`resolution_m` > 0, got {self.resolution_m}.",
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.height, self.width

    @property
    def extent_m(self) -> tuple[float, float]:
        """Size of the map along x and y in metres."""
        return self.width * self.resolution_m, self.height * self.resolution_m

    def maps_in(self, cells: int) -> int:
        """Number of maps that have so many cells together at most, but at least one."""
        return max(1, cells // (self.height * self.width))

    def contains(self, x_m: "Tensor", y_m: "Tensor") -> "Tensor":
        """Tells which positions lie on the map, bool, shape of `x_m`."""
        extent_x, extent_y = self.extent_m
        return (x_m >= 0) & (x_m < extent_x) & (y_m >= 0) & (y_m < extent_y)

    def cell_of(self, x_m: "Tensor", y_m: "Tensor") -> "tuple[Tensor, Tensor]":
        """Finds the cell of each position; positions off the map give the nearest
        border cell.

        Returns:
            Row and column, int64, each of the shape of `x_m`.
        """
        row = (y_m / self.resolution_m).floor().long().clamp(0, self.height - 1)
        column = (x_m / self.resolution_m).floor().long().clamp(0, self.width - 1)
        return row, column

    def centre_of(self, row: "Tensor", column: "Tensor") -> "tuple[Tensor, Tensor]":
        """Gives the position (x, y) in metres of the centre of each cell."""
        return (column + 0.5) * self.resolution_m, (row + 0.5) * self.resolution_m

    def pad(self, maps: "Tensor", outside: float) -> "Tensor":
        """Frames maps with one cell of the value that holds off the map, for `lookup`.

        Args:
            maps: shape [*B, H, W].
            outside: the value off the map.

        Returns:
            Shape [*B, (H + 2)·(W + 2)].
        """
        import torch

        return torch.nn.functional.pad(maps, (1, 1, 1, 1), value=outside).flatten(-2)

    def lookup(self, padded: "Tensor", x_m: "Tensor", y_m: "Tensor") -> "Tensor":
        """Reads each member's map at positions; one that is not a number reads as off
        the map.

        Args:
            padded: maps from `pad`, shape [B, (H + 2)·(W + 2)].
            x_m: positions, shape [B, *S].
            y_m: positions, shape [B, *S].

        Returns:
            Values, dtype of `padded`, shape [B, *S].
        """
        import torch

        row, column = (
            (y_m / self.resolution_m).floor() + 1,
            (x_m / self.resolution_m).floor() + 1,
        )
        # Not `clamp(0, …)`: a comparison with what is not a number is false, so that it
        # gives 0.
        row = torch.where(row > 0, row, 0).clamp(max=self.height + 1).long()
        column = torch.where(column > 0, column, 0).clamp(max=self.width + 1).long()
        index = row * (self.width + 2) + column
        return torch.gather(padded, 1, index.reshape(len(padded), -1)).reshape(
            x_m.shape
        )


def is_azimuth(layer: str) -> bool:
    """Tells by its name a layer of directions: in degrees from +x towards +y, which
    turn with the map.
    """
    return layer.endswith("_azimuth_deg")


def outline(region: np.ndarray, resolution_m: float) -> np.ndarray:
    """Finds the edges between cells of a region and those that are not of it, the map's
    border among them.

    Args:
        region: bool, shape [H, W].
        resolution_m: edge length of a cell.

    Returns:
        Both ends (x, y) of each edge in metres, float32, shape [M, 2, 2].
    """
    framed = np.pad(region, 1)
    rows, columns = np.nonzero(np.diff(framed[:, 1:-1], axis=0))
    along_x = np.stack((columns, rows, columns + 1, rows), axis=1)
    rows, columns = np.nonzero(np.diff(framed[1:-1], axis=1))
    along_y = np.stack((columns, rows, columns, rows + 1), axis=1)
    edges = np.concatenate((along_x, along_y)).reshape(-1, 2, 2)
    return (edges * resolution_m).astype(np.float32)
