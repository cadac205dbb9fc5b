"""What robots have seen of the ground: the memory of their looks, and the map that a
model is given of it.

Letters in shapes: B episodes, H×W cells.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.grid import Grid
from benchnav.core.ground import SEEN
from benchnav.core.terrain import Observation, Terrain
from benchnav.datagen.schema import quantise
from benchnav.datagen.synth.elevation import slopes_deg
from benchnav.planning.sensing.sensor import Appearance


@dataclass(frozen=True, kw_only=True)
class Memory(Batch):
    """The best look at each cell so far; of cells not seen it means nothing.

    Args:
        seen: which cells were seen, bool, shape [B, H, W].
        rgb: uint8, shape [B, 3, H, W].
        elevation_m: shape [B, H, W].
        layers: the map's other layers, by name, each of shape [B, H, W].
        doubt: how noisy the look was, in the sensor's unit, shape [B, H, W].
        grid: size and resolution.
    """

    seen: Tensor
    rgb: Tensor
    elevation_m: Tensor
    layers: Mapping[str, Tensor]
    noise_level: Tensor
    grid: Grid

    @classmethod
    def none(cls, terrain: Terrain | Observation) -> Self:
        """Nothing was seen yet.

        Args:
            terrain: B maps, for their shapes, dtypes and names of layers alone.
        """
        unknown = torch.full_like(terrain.elevation_m, torch.nan)
        return cls(
            seen=torch.zeros_like(unknown, dtype=torch.bool),
            rgb=torch.zeros_like(terrain.rgb),
            elevation_m=unknown,
            layers={
                name: torch.full_like(layer, torch.nan)
                for name, layer in terrain.layers.items()
            },
            noise_level=torch.full_like(unknown, torch.inf),
            grid=terrain.grid,
        )


def remember(memory: Memory, appearance: Appearance) -> Memory:
    """Adds a look: each cell keeps the look with the least doubt, of equal ones the
    earlier.

    Args:
        memory: of B episodes.
        appearance: what the same episodes see now, with all layers that the memory has.
    """
    seen, look = appearance.seen, appearance.observation
    noise_level = appearance.noise_level.to(memory.noise_level)
    better = seen & (~memory.seen | (noise_level < memory.noise_level))
    return Memory(
        seen=memory.seen | seen,
        rgb=torch.where(better[:, None], look.rgb, memory.rgb),
        elevation_m=torch.where(better, look.elevation_m, memory.elevation_m),
        layers={
            name: torch.where(better, look.layers[name], kept)
            for name, kept in memory.layers.items()
        },
        noise_level=torch.where(better, noise_level, memory.noise_level),
        grid=memory.grid,
    )


def masked(memory: Memory, layer_means: Mapping[str, tuple[float, ...]]) -> Observation:
    """The map as far as it was seen, for a model.

    Slopes are those of the elevation that was seen, as recipes make them: by Horn's
    method, continued linearly at the map's borders. So all that was seen without noise
    is what the terrain's own observation has, bit for bit; but for border cells of
    imported ground, whose slopes know the ground beyond the map.

    Args:
        memory: of B episodes.
        layer_means: means of the training maps, by layer, as `GroundStatistics` has
            them: of `rgb`, `elevation_m` and `slope_deg`.

    Returns:
        Colour, rounded, and elevation are the training mean where a cell was not seen,
        and slope where the cell or one of its neighbours on the map was not. Layers are
        NaN where a cell was not seen. The layer `seen` is 1 where it was, else 0.
    """
    seen = memory.seen
    colour = torch.tensor(layer_means["rgb"]).round().to(memory.rgb)
    (height,), (slope,) = layer_means["elevation_m"], layer_means["slope_deg"]
    elevation_m = torch.where(seen, memory.elevation_m, height)
    # A cell is dark where it or a neighbour was not seen; what lies beyond the map is
    # not asked for.
    unseen = torch.nn.functional.max_pool2d((~seen).float(), 3, stride=1, padding=1) > 0
    slopes = quantise(
        slopes_deg(elevation_m.cpu().numpy(), memory.grid.resolution_m), 10
    )
    return Observation(
        rgb=torch.where(seen[:, None], memory.rgb, colour[:, None, None]),
        elevation_m=elevation_m,
        slope_deg=torch.where(unseen, slope, torch.from_numpy(slopes).to(elevation_m)),
        grid=memory.grid,
        layers={
            **{
                name: torch.where(seen, layer, torch.nan)
                for name, layer in memory.layers.items()
            },
            SEEN: seen.to(torch.float32),
        },
    )
