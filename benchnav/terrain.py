"""Terrain value types: the grid, what is true of the ground, and what a robot may see of it.

Conventions: maps are indexed [row = y, column = x]; cell (i, j) is centred at
((j + ½)·res, (i + ½)·res); a position belongs to the cell it lies in; outside the map is not free
space. Traversability is in [0, 1] and higher is better. Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.mixture import TraversabilityMixture


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
        if self.height < 3 or self.width < 3:
            raise ConfigError(f"Expected a grid of at least 3×3 cells, got {self.height}×{self.width}.")
        if not 0 < self.resolution_m < float("inf"):
            raise ConfigError(f"Expected `resolution_m` > 0, got {self.resolution_m}.")

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.height, self.width

    @property
    def extent_m(self) -> tuple[float, float]:
        """Size of the map along x and y in metres."""
        return self.width * self.resolution_m, self.height * self.resolution_m

    def contains(self, x_m: Tensor, y_m: Tensor) -> Tensor:
        """Tells which positions lie on the map, bool, shape of `x_m`."""
        extent_x, extent_y = self.extent_m
        return (x_m >= 0) & (x_m < extent_x) & (y_m >= 0) & (y_m < extent_y)

    def cell_of(self, x_m: Tensor, y_m: Tensor) -> tuple[Tensor, Tensor]:
        """Finds the cell of each position; positions off the map give the nearest border cell.

        Returns:
            Row and column, int64, each of the shape of `x_m`.
        """
        row = (y_m / self.resolution_m).floor().long().clamp(0, self.height - 1)
        column = (x_m / self.resolution_m).floor().long().clamp(0, self.width - 1)
        return row, column

    def centre_of(self, row: Tensor, column: Tensor) -> tuple[Tensor, Tensor]:
        """Gives the position (x, y) in metres of the centre of each cell."""
        return (column + 0.5) * self.resolution_m, (row + 0.5) * self.resolution_m

    def pad(self, maps: Tensor, outside: float) -> Tensor:
        """Frames maps with one cell of the value that holds off the map, for `lookup`.

        Args:
            maps: shape [B, H, W].
            outside: the value off the map.

        Returns:
            Shape [B, (H + 2)·(W + 2)].
        """
        return torch.nn.functional.pad(maps, (1, 1, 1, 1), value=outside).flatten(1)

    def lookup(self, padded: Tensor, x_m: Tensor, y_m: Tensor) -> Tensor:
        """Reads each member's map at positions; one that is not a number reads as off the map.

        Args:
            padded: maps from `pad`, shape [B, (H + 2)·(W + 2)].
            x_m: positions, shape [B, *S].
            y_m: positions, shape [B, *S].

        Returns:
            Values, dtype of `padded`, shape [B, *S].
        """
        row, column = (y_m / self.resolution_m).floor() + 1, (x_m / self.resolution_m).floor() + 1
        # Not `clamp(0, …)`: a comparison with what is not a number is false, so that it gives 0.
        row = torch.where(row > 0, row, 0).clamp(max=self.height + 1).long()
        column = torch.where(column > 0, column, 0).clamp(max=self.width + 1).long()
        index = row * (self.width + 2) + column
        return torch.gather(padded, 1, index.reshape(len(padded), -1)).reshape(x_m.shape)


@dataclass(frozen=True)
class Observation:
    """The paper's o: all that a traversability model may see.

    Args:
        rgb: top-down colour image, uint8, shape [B, 3, H, W].
        elevation_m: shape [B, H, W].
        slope_deg: inclination by Horn's method, shape [B, H, W].
        grid: size and resolution.
    """

    rgb: Tensor
    elevation_m: Tensor
    slope_deg: Tensor
    grid: Grid

    def __post_init__(self) -> None:
        """Checks that the layers fit the grid and one another."""
        batch = self.rgb.shape[0]
        _check_shapes(self.grid, batch, elevation_m=self.elevation_m, slope_deg=self.slope_deg)
        if self.rgb.dtype != torch.uint8 or self.rgb.shape != (batch, 3, *self.grid.shape):
            raise ConfigError(
                f"Expected `rgb` as uint8 of shape [B, 3, {self.grid.height}, {self.grid.width}], "
                f"got {self.rgb.dtype} of shape {list(self.rgb.shape)}."
            )


@dataclass(frozen=True, kw_only=True)
class Terrain:
    """The ground as it is. Only the simulation and the `oracle` model are given this.

    Args:
        rgb: uint8, shape [B, 3, H, W].
        class_id: index into the dataset's class table, shape [B, H, W].
        elevation_m: shape [B, H, W].
        slope_deg: shape [B, H, W].
        truth: the true distribution of λ in each cell, parameters of shape [B, K, H, W]: of the cell's
            own class at its slope, and of its soft spots where the class has them.
        traversability: one realised λ, shape [B, H, W].
        grid: size and resolution.
        look_alikes: gives what colours can tell at best, from classes and slopes [B, H, W]: the truth of all
            classes that look like the cell's own, weighted alike; None where no two classes look alike, so
            that it is the truth.
    """

    rgb: Tensor
    class_id: Tensor
    elevation_m: Tensor
    slope_deg: Tensor
    truth: TraversabilityMixture
    traversability: Tensor
    grid: Grid
    look_alikes: Callable[[Tensor, Tensor], TraversabilityMixture] | None = None

    def __post_init__(self) -> None:
        """Checks that the layers fit the grid and one another."""
        _check_shapes(
            self.grid,
            self.rgb.shape[0],
            class_id=self.class_id,
            elevation_m=self.elevation_m,
            slope_deg=self.slope_deg,
            truth=self.truth.weights.select(-3, 0),
            traversability=self.traversability,
        )

    def __len__(self) -> int:
        """Number of maps B."""
        return self.rgb.shape[0]

    def select(self, members: Tensor) -> "Terrain":
        """Keeps some maps, by index, shape [M]; a map may be taken more than once."""
        kept: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, TraversabilityMixture):
                kept[f.name] = value.select(members)
            else:
                kept[f.name] = value[members] if isinstance(value, Tensor) else value
        return Terrain(**kept)

    def to(self, device: torch.device | str) -> "Terrain":
        """The maps on a device."""
        movable = (Tensor, TraversabilityMixture)
        moved: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        for name, value in moved.items():
            moved[name] = value.to(device) if isinstance(value, movable) else value
        return Terrain(**moved)

    def observe(self) -> Observation:
        """Gives the Observation of these maps: colour, elevation, slope, grid, and nothing else."""
        return Observation(self.rgb, self.elevation_m, self.slope_deg, self.grid)


def _check_shapes(grid: Grid, batch: int, **layers: Tensor) -> None:
    for name, layer in layers.items():
        if layer.shape != (batch, *grid.shape):
            raise ConfigError(
                f"Expected `{name}` of shape [{batch}, {grid.height}, {grid.width}], "
                f"got {list(layer.shape)}. Pass a batch of maps on one grid."
            )
