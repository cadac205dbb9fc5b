"""Grid of a map: conversion between positions and cells.

Maps are indexed [row = y, column = x]. The centre (x, y) of cell (i, j) is
((j + ½)·r, (i + ½)·r), where r is the resolution. A position belongs to the cell that
contains it. Positions off the map are not free. Letters in shapes: B maps; H×W cells;
*B any leading dimensions; *S any dimensions of positions; M edges.

PyTorch is imported within functions, because generating and listing datasets does not
need it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from benchnav.core.errors import expect

if TYPE_CHECKING:
    from torch import Tensor


MAX_CELLS = 2**28  # maximum for a map; fields of a larger map exceed any memory


@dataclass(frozen=True)
class Grid:
    """Size and resolution of a map.

    Args:
        height: number of rows (cells along y), at least 3.
        width: number of columns (cells along x), at least 3.
        resolution_m: edge length of a square cell in metres, > 0.

    Raises:
        ConfigError: If a size or the resolution is out of range.
    """

    height: int
    width: int
    resolution_m: float

    def __post_init__(self) -> None:
        """Check the size and the resolution."""
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
            f"`resolution_m` > 0 and finite, got {self.resolution_m}.",
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (H, W) of a map."""
        return self.height, self.width

    @property
    def extent_m(self) -> tuple[float, float]:
        """Lengths of the map along x and y in metres."""
        along_x = self.width * self.resolution_m
        along_y = self.height * self.resolution_m
        return along_x, along_y

    def maps_in(self, cells: int) -> int:
        """Return the number of maps that have `cells` cells in total, at least 1."""
        return max(1, cells // (self.height * self.width))

    def contains(self, x_m: "Tensor", y_m: "Tensor") -> "Tensor":
        """Return a mask of the positions on the map, bool, shape of `x_m`."""
        extent_x, extent_y = self.extent_m
        in_x = (x_m >= 0) & (x_m < extent_x)
        in_y = (y_m >= 0) & (y_m < extent_y)
        return in_x & in_y

    def cell_of(self, x_m: "Tensor", y_m: "Tensor") -> "tuple[Tensor, Tensor]":
        """Return the cell of each position; off the map, the nearest border cell.

        Args:
            x_m: positions along x in metres.
            y_m: positions along y in metres, shape of `x_m`.

        Returns:
            Rows and columns, int64, each of the shape of `x_m`.
        """
        row = (y_m / self.resolution_m).floor().long().clamp(0, self.height - 1)
        column = (x_m / self.resolution_m).floor().long().clamp(0, self.width - 1)
        return row, column

    def centre_of(self, row: "Tensor", column: "Tensor") -> "tuple[Tensor, Tensor]":
        """Return the position (x, y) in metres of the centre of each cell."""
        x_m = (column + 0.5) * self.resolution_m
        y_m = (row + 0.5) * self.resolution_m
        return x_m, y_m

    def pad(self, maps: "Tensor", outside: float) -> "Tensor":
        """Return maps padded by one cell on each side and flattened, for `lookup`.

        Args:
            maps: maps of any dtype, shape [*B, H, W].
            outside: value of the padding, for positions off the map.

        Returns:
            Padded maps, dtype of `maps`, shape [*B, (H + 2)·(W + 2)].
        """
        import torch

        padded = torch.nn.functional.pad(maps, (1, 1, 1, 1), value=outside)
        return padded.flatten(-2)

    def lookup(self, padded: "Tensor", x_m: "Tensor", y_m: "Tensor") -> "Tensor":
        """Return the values of maps at positions; NaN positions count as off the map.

        Args:
            padded: maps from `pad`, shape [B, (H + 2)·(W + 2)].
            x_m: positions along x in metres, shape [B, *S].
            y_m: positions along y in metres, shape [B, *S].

        Returns:
            Values, dtype of `padded`, shape [B, *S].
        """
        import torch

        row = (y_m / self.resolution_m).floor() + 1
        column = (x_m / self.resolution_m).floor() + 1
        # `clamp(0, …)` would keep NaN. A comparison with NaN is false and yields 0.
        row = torch.where(row > 0, row, 0)
        row = row.clamp(max=self.height + 1).long()
        column = torch.where(column > 0, column, 0)
        column = column.clamp(max=self.width + 1).long()
        index = row * (self.width + 2) + column
        values = torch.gather(padded, 1, index.reshape(len(padded), -1))
        return values.reshape(x_m.shape)


def is_azimuth(layer: str) -> bool:
    """Return whether a layer contains directions, as the end of its name indicates.

    Directions are in degrees from +x towards +y, and rotate with the map.
    """
    return layer.endswith("_azimuth_deg")


def outline(region: np.ndarray, resolution_m: float) -> np.ndarray:
    """Return the boundary of a region as cell edges, map borders included.

    Args:
        region: mask of the region, bool, shape [H, W].
        resolution_m: edge length of a cell in metres.

    Returns:
        Both ends (x, y) of each edge in metres, float32, shape [M, 2, 2].
    """
    padded = np.pad(region, 1)
    changes_down = np.diff(padded[:, 1:-1], axis=0)
    rows, columns = np.nonzero(changes_down)
    along_x = np.stack((columns, rows, columns + 1, rows), axis=1)
    changes_across = np.diff(padded[1:-1], axis=1)
    rows, columns = np.nonzero(changes_across)
    along_y = np.stack((columns, rows, columns, rows + 1), axis=1)
    edges = np.concatenate((along_x, along_y)).reshape(-1, 2, 2)
    return (edges * resolution_m).astype(np.float32)
