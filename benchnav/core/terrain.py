"""Terrain value types: the true terrain and its observation.

Traversability is in [0, 1]; higher is better. Letters in shapes: B maps, H×W cells.
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
    """Observation o of the paper: the complete input of a traversability model.

    Args:
        rgb: top-down colour image, uint8, shape [B, 3, H, W].
        elevation_m: elevation in metres, shape [B, H, W].
        slope_deg: inclination in degrees by Horn's method, shape [B, H, W].
        grid: size and resolution of the maps.
        layers: optional layers by name, such as `vegetation_m`, each float32 of shape
            [B, H, W]; NaN in cells without a value.
    """

    rgb: Tensor
    elevation_m: Tensor
    slope_deg: Tensor
    grid: Grid
    layers: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check dtypes and shapes against the grid."""
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
    """True terrain, which only the simulation and the `oracle` model receive.

    Args:
        rgb: top-down colour image, uint8, shape [B, 3, H, W].
        class_id: index into the dataset's class table, 255 where the cell is
            unlabelled, shape [B, H, W].
        elevation_m: elevation in metres, shape [B, H, W].
        slope_deg: inclination in degrees, shape [B, H, W].
        truth: true distribution of λ in each cell, given its class and slope; it
            includes the soft spots of the class. Parameters have shape [B, K, H, W].
            Means are NaN in unlabelled cells.
        traversability: one realisation of λ, in [0, 1], shape [B, H, W].
        grid: size and resolution of the maps.
        look_alikes: function of the terrain that returns the best prediction of λ from
            colour: in each cell, the mixture of the distributions of the look-alike
            classes, weighted by their frequencies. If None, no classes are look-alikes,
            and the best prediction is `truth`.
        slope_law: function from slopes in degrees, shape [N], to the mean λ of firm
            terrain of each class, shape [C, N]; None if the dataset has no such laws.
        layers: optional layers by name, as in `Observation`.
    """

    rgb: Tensor
    class_id: Tensor
    elevation_m: Tensor
    slope_deg: Tensor
    truth: TraversabilityMixture
    traversability: Tensor
    grid: Grid
    look_alikes: "Callable[[Terrain], TraversabilityMixture] | None" = None
    slope_law: Callable[[Tensor], Tensor] | None = None
    layers: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check dtypes and shapes against the grid."""
        maps = {
            "class_id": self.class_id,
            "elevation_m": self.elevation_m,
            "slope_deg": self.slope_deg,
            "truth": self.truth.weights.select(-3, 0),
            "traversability": self.traversability,
        }
        _check_shapes(self.grid, self.rgb.shape[0], maps, self.layers)

    def __len__(self) -> int:
        """Return the number of maps B."""
        return self.rgb.shape[0]

    def observe(self) -> Observation:
        """Return the observation of these maps, without class, truth and λ."""
        return Observation(
            self.rgb, self.elevation_m, self.slope_deg, self.grid, self.layers
        )


def take_cells(observation: Observation, rows: Any, columns: Any) -> Observation:
    """Return selected cells of an observation as a map.

    Args:
        observation: maps of shape [B, H, W].
        rows: slice or indices of rows; indices of rows and columns broadcast to [h, w].
        columns: slice or indices of columns.

    Returns:
        An observation with maps of shape [B, h, w].
    """

    def select(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: select(layer) for name, layer in value.items()}
        return value[..., rows, columns] if isinstance(value, Tensor) else value

    names = [attribute.name for attribute in fields(observation)]
    selected = {name: select(getattr(observation, name)) for name in names}
    height, width = selected["rgb"].shape[-2:]
    selected["grid"] = Grid(height, width, observation.grid.resolution_m)
    return replace(observation, **selected)


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
            f"layer `{name}` as float32 with a unique name other than `rgb`, got "
            f"{values.dtype}.",
        )
