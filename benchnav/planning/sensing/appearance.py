"""Memory of the observed appearance, and the model's input that follows from it.

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
    """Least noisy observation of each cell; values of unobserved cells are undefined.

    Args:
        seen: mask of observed cells, bool, shape [B, H, W].
        rgb: colour, uint8, shape [B, 3, H, W].
        elevation_m: elevation in metres, shape [B, H, W].
        layers: the map's other layers by name, each of shape [B, H, W].
        noise_level: noise level of each cell's observation, in the sensor's unit; ∞ if
            the cell is unobserved, shape [B, H, W].
        grid: size and resolution of the maps.
    """

    seen: Tensor
    rgb: Tensor
    elevation_m: Tensor
    layers: Mapping[str, Tensor]
    noise_level: Tensor
    grid: Grid

    @classmethod
    def empty(cls, terrain: Terrain | Observation) -> Self:
        """Return an empty memory.

        Args:
            terrain: B maps; only their shapes, dtypes and layer names are used.
        """
        unobserved = torch.full_like(terrain.elevation_m, torch.nan)
        layers = {}
        for name, layer in terrain.layers.items():
            layers[name] = torch.full_like(layer, torch.nan)
        seen = torch.zeros_like(unobserved, dtype=torch.bool)
        noise_level = torch.full_like(unobserved, torch.inf)
        return cls(
            seen=seen,
            rgb=torch.zeros_like(terrain.rgb),
            elevation_m=unobserved,
            layers=layers,
            noise_level=noise_level,
            grid=terrain.grid,
        )


def remember(memory: Memory, appearance: Appearance) -> Memory:
    """Return the memory with added observations.

    Each cell keeps its least noisy observation. If two observations are equally noisy,
    it keeps the earlier one.

    Args:
        memory: memory of B episodes; it is not changed.
        appearance: new appearance in the same episodes, with all layers of the memory.
    """
    seen = appearance.seen
    observation = appearance.observation
    noise_level = appearance.noise_level.to(memory.noise_level)
    is_less_noisy = noise_level < memory.noise_level
    is_replaced = seen & (~memory.seen | is_less_noisy)
    rgb = torch.where(is_replaced[:, None], observation.rgb, memory.rgb)
    elevation_m = torch.where(is_replaced, observation.elevation_m, memory.elevation_m)
    layers = {}
    for name, layer in memory.layers.items():
        layers[name] = torch.where(is_replaced, observation.layers[name], layer)
    return Memory(
        seen=memory.seen | seen,
        rgb=rgb,
        elevation_m=elevation_m,
        layers=layers,
        noise_level=torch.where(is_replaced, noise_level, memory.noise_level),
        grid=memory.grid,
    )


def model_input(
    memory: Memory, layer_means: Mapping[str, tuple[float, ...]]
) -> Observation:
    """Return the observed part of the map as the input of a model.

    Slopes are computed from the observed elevation as in generated datasets: by Horn's
    method, with linear extrapolation at the map's borders. Hence cells observed without
    noise equal those of `Terrain.observe` bit for bit. Border cells of imported terrain
    are an exception, since their true slopes include terrain beyond the map.

    Args:
        memory: memory of B episodes.
        layer_means: means of `rgb`, `elevation_m` and `slope_deg` over the training
            maps, as in `GroundStatistics`.

    Returns:
        The observation of B maps. In unobserved cells, colour (rounded) and elevation
        are the training means. The slope of a cell is the training mean if the cell or
        any of its eight neighbours is unobserved. Other layers are NaN in unobserved
        cells. The layer `seen` is 1 in observed cells and 0 in others.
    """
    seen = memory.seen
    mean_rgb = torch.tensor(layer_means["rgb"])
    mean_colour = mean_rgb.round().to(memory.rgb)
    (mean_elevation_m,) = layer_means["elevation_m"]
    (mean_slope_deg,) = layer_means["slope_deg"]
    rgb = torch.where(seen[:, None], memory.rgb, mean_colour[:, None, None])
    elevation_m = torch.where(seen, memory.elevation_m, mean_elevation_m)
    # A slope needs the cell and its neighbours on the map. The pooling pads with −∞, so
    # that cells beyond the map do not count as unobserved.
    unseen = (~seen).float()
    near_unseen = torch.nn.functional.max_pool2d(unseen, 3, stride=1, padding=1)
    lacks_slope = near_unseen > 0
    heights = elevation_m.cpu().numpy()
    exact_slopes = slopes_deg(heights, memory.grid.resolution_m)
    slopes = torch.from_numpy(quantise(exact_slopes, 10)).to(elevation_m)
    slope_deg = torch.where(lacks_slope, mean_slope_deg, slopes)
    layers = {}
    for name, layer in memory.layers.items():
        layers[name] = torch.where(seen, layer, torch.nan)
    layers[SEEN] = seen.to(torch.float32)
    return Observation(
        rgb=rgb,
        elevation_m=elevation_m,
        slope_deg=slope_deg,
        grid=memory.grid,
        layers=layers,
    )
