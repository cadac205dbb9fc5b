"""Random masks of training maps, to train a network for partly observed terrain.

A masked map is what a robot observes on a straight path with an all-round camera, without
occlusion by hills: cells within a radius of the path, with noise that grows with distance
to the path. Unobserved cells have the training mean, as in a robot's map
(`benchnav.planning.sensing`). Losses and metrics use only observed cells: in unobserved
cells a network could learn only the frequency of classes, which the terrain statistics
describe better.
Letters in shapes: b maps in a batch, H×W cells.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.ground import SEEN
from benchnav.datagen.schema import UNLABELLED
from benchnav.datagen.synth.elevation import slopes_deg
from benchnav.models.config import Masking


@dataclass(frozen=True, kw_only=True)
class RandomMasks:
    """Random masks of maps.

    Args:
        masking: settings of the masks.
        means: means of the training maps by layer, as in `GroundStatistics`.
        resolution_m: cell width in metres.
    """

    masking: Masking
    means: Mapping[str, tuple[float, ...]]
    resolution_m: float

    def apply(self, maps: Mapping[str, Tensor], uniform: Tensor) -> dict[str, Tensor]:
        """Mask a batch.

        Args:
            maps: fields of b maps by name, each of shape [b, *, H, W]; `slope_deg`
                requires `elevation_m`.
            uniform: uniform random numbers of each map, which determine whether the map
                is masked, the radius, both ends of the path (x, y), the driven fraction of
                the path, and the seed of the noise; float64, shape [b, 8].

        Returns:
            The same fields and `seen`. In unobserved cells, colour and elevation are the
            training mean, `class_id` is unlabelled, and other fields are NaN. Slope is the
            training mean in unobserved cells and their neighbours.
        """
        height, width = next(iter(maps.values())).shape[-2:]
        distance = path_distances(uniform[:, 2:7], (height, width), self.resolution_m)
        low, high = self.masking.radius_m
        radius = low * (high / low) ** uniform[:, 1]
        is_masked = (uniform[:, 0] < self.masking.share)[:, None, None]
        seen = ~is_masked | (distance <= radius[:, None, None])
        spread = torch.where(is_masked, distance, 0).float()
        noise = spread[:, None] * _normal(uniform[:, 7], is_masked, (4, height, width))
        batch: dict[str, Tensor] = {SEEN: seen.float()}
        for name, layer in maps.items():
            if name == "rgb":
                batch[name] = self._mask_colour(layer, seen, noise[:, :3])
            elif name == "elevation_m":
                elevation = layer + self.masking.elevation_noise * noise[:, 3]
                batch[name] = torch.where(seen, elevation, self.means[name][0])
                if "slope_deg" in maps:
                    steep = slopes_deg(elevation.numpy(), self.resolution_m)
                    noisy_slope = torch.from_numpy(steep).to(elevation)
                    slope = torch.where(is_masked, noisy_slope, maps["slope_deg"])
                    batch["slope_deg"] = self._mask_slope(slope, seen)
            elif name not in ("slope_deg", SEEN):
                missing = UNLABELLED if name == "class_id" else torch.nan
                batch[name] = torch.where(seen, layer, missing).to(layer.dtype)
        return batch

    def _mask_colour(self, rgb: Tensor, seen: Tensor, noise: Tensor) -> Tensor:
        """Return noisy colours, or the mean colour in unobserved cells."""
        noisy = rgb + self.masking.colour_noise * noise
        colour = noisy.round().clamp(0, 255).to(rgb.dtype)
        mean = torch.tensor(self.means["rgb"]).round().to(rgb.dtype)
        return torch.where(seen[:, None], colour, mean[:, None, None])

    def _mask_slope(self, slope: Tensor, seen: Tensor) -> Tensor:
        """Return slopes, or the mean slope in unobserved cells and their neighbours."""
        unseen = (~seen).float()
        near_unseen = torch.nn.functional.max_pool2d(unseen, 3, stride=1, padding=1) > 0
        return torch.where(near_unseen, self.means["slope_deg"][0], slope)


def path_distances(path: Tensor, shape: tuple[int, int], resolution_m: float) -> Tensor:
    """Return the distances of cells to straight paths, one path per map.

    Args:
        path: start (x, y) and end (x, y) as fractions of the map's sides, and the
            driven fraction of the path, shape [b, 5].
        shape: (H, W) of the maps.
        resolution_m: cell width in metres.

    Returns:
        Distances of the cell centres in metres, float64, shape [b, H, W].
    """
    height, width = shape
    rows = (torch.arange(height, dtype=torch.float64) + 0.5) * resolution_m
    columns = (torch.arange(width, dtype=torch.float64) + 0.5) * resolution_m
    extent = resolution_m * torch.tensor([width, height], dtype=torch.float64)
    start = path[:, :2] * extent
    driven = (path[:, 2:4] - path[:, :2]) * extent * path[:, 4:]
    x0, y0 = start.T[..., None, None]
    dx, dy = driven.T[..., None, None]
    from_x = columns - x0
    from_y = rows[:, None] - y0
    squared_length = (dx**2 + dy**2).clamp(min=1e-12)
    fraction = ((from_x * dx + from_y * dy) / squared_length).clamp(0, 1)
    return torch.hypot(from_x - fraction * dx, from_y - fraction * dy)


def _normal(seeds: Tensor, is_masked: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return standard normal noise of each map, shape [b, *shape]; 0 if not masked.

    Args:
        seeds: seed of each map, a number in (0, 1), shape [b].
        is_masked: whether each map is masked, bool, shape [b, 1, 1].
        shape: shape of the noise of a map.
    """
    noise = []
    for seed, has_noise in zip(seeds.tolist(), is_masked, strict=True):
        if bool(has_noise):
            generator = rng.generator(int(seed * 2**53))
            noise.append(torch.randn(shape, generator=generator))
        else:
            noise.append(torch.zeros(shape))
    return torch.stack(noise)
