"""Terrain value types: what is true of the ground, and what a robot may see of it.

Traversability is in [0, 1] and higher is better. Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture


@dataclass(frozen=True)
class Observation(Batch):
    """The paper's o: all that a traversability model may see.

    Args:
        rgb: top-down colour image, uint8, shape [B, 3, H, W].
        elevation_m: shape [B, H, W].
        slope_deg: inclination by Horn's method, shape [B, H, W].
        grid: size and resolution.
        layers: what else there is of the ground, by name, such as `vegetation_m`;
            float32, NaN where nothing is known, each of shape [B, H, W].
    """

    rgb: Tensor
    elevation_m: Tensor
    slope_deg: Tensor
    grid: Grid
    layers: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Checks that the layers fit the grid and one another."""
        batch = self.rgb.shape[0]
        maps = {"elevation_m": self.elevation_m, "slope_deg": self.slope_deg}
        _check_shapes(self.grid, batch, maps, self.layers)
        expect(
            self.rgb.dtype == torch.uint8
            and self.rgb.shape == (batch, 3, *self.grid.shape),
            f"`rgb` as uint8 of shape [B, 3, {self.grid.height}, {self.grid.width}], "
            f"got {self.rgb.dtype} of shape {list(self.rgb.shape)}.",
        )


@dataclass(frozen=True, kw_only=True)
class Terrain(Batch):
    """The ground as it is. Only the simulation and the `oracle` model are given this.

    Args:
        rgb: uint8, shape [B, 3, H, W].
        class_id: index into the dataset's class table, 255 where the class is not
            known, shape [B, H, W].
        elevation_m: shape [B, H, W].
        slope_deg: shape [B, H, W].
        truth: the true distribution of λ in each cell, parameters of shape [B, K, H,
            W]: of the cell's own class at its slope, and of its soft spots where the
            class has them. Means are NaN where the class is not known.
        traversability: one realised λ, shape [B, H, W].
        grid: size and resolution.
        look_alikes: gives what colours can tell of a terrain at best: in each cell the
            truth of all classes that look like the cell's own, weighted by how often
            they do; None where no two classes look alike, so that it is the truth.
        layers: optional fields, by name, as an `Observation` has them.
    """

    rgb: Tensor
    class_id: Tensor
    elevation_m: Tensor
    slope_deg: Tensor
    truth: TraversabilityMixture
    traversability: Tensor
    grid: Grid
    look_alikes: "Callable[[Terrain], TraversabilityMixture] | None" = None
    layers: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Checks that the layers fit the grid and one another."""
        maps = {
            "class_id": self.class_id,
            "elevation_m": self.elevation_m,
            "slope_deg": self.slope_deg,
            "truth": self.truth.weights.select(-3, 0),
            "traversability": self.traversability,
        }
        _check_shapes(self.grid, self.rgb.shape[0], maps, self.layers)

    def __len__(self) -> int:
        """Number of maps B."""
        return self.rgb.shape[0]

    def observe(self) -> Observation:
        """Gives the Observation of these maps: colour, elevation, slope, grid, layers,
        and nothing else.
        """
        return Observation(
            self.rgb, self.elevation_m, self.slope_deg, self.grid, self.layers
        )


def take_cells(observation: Observation, rows: Any, columns: Any) -> Observation:
    """Cells of an observation as a map of their own, by slices or by indices that
    broadcast to [h, w].
    """

    def change(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: change(layer) for name, layer in value.items()}
        return value[..., rows, columns] if isinstance(value, Tensor) else value

    taken = {
        each.name: change(getattr(observation, each.name))
        for each in fields(observation)
    }
    height, width = taken["rgb"].shape[-2:]
    grid = Grid(height, width, observation.grid.resolution_m)
    return replace(observation, **taken | {"grid": grid})


def _check_shapes(
    grid: Grid, batch: int, maps: Mapping[str, Tensor], layers: Mapping[str, Tensor]
) -> None:
    for name, values in {**maps, **layers}.items():
        expect(
            values.shape == (batch, *grid.shape),
            f"`{name}` of shape [{batch}, {grid.height}, {grid.width}], got "
            f"{list(values.shape)}. "
            "Pass a batch of maps on one grid.",
        )
    for name, values in layers.items():
        expect(
            name not in maps and name != "rgb" and values.dtype == torch.float32,
            f"layer `{name}` as float32 under a name of its own, got {values.dtype}.",
        )
