"""Random masks of training maps, so that a network learns to predict partly observed
terrain.

A masked map shows what a robot observes on a straight path with a camera of all-round
view, without occlusion by hills: cells within a radius of the path, with noise that
grows with distance. Unobserved cells have the training mean, as in a robot's map
(`benchnav.planning.sensing`). Losses and metrics count observed cells only: in other
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
    """Masks maps at random.

    Args:
        masking: settings of the masks.
        means: of the training maps, by layer, as in `GroundStatistics`.
        resolution_m: cell width in metres.
    """

    masking: Masking
    means: Mapping[str, tuple[float, ...]]
    resolution_m: float

    def apply(self, maps: Mapping[str, Tensor], uniform: Tensor) -> dict[str, Tensor]:
        """Mask a batch.

        Args:
            maps: by field, each of shape [b, *, H, W]; `slope_deg` requires
                `elevation_m`.
            uniform: uniform random numbers of each map: whether it is masked, the radius,
                both ends of the path (x, y), the driven fraction of the path, and the
                seed of its noise; float64, shape [b, 8].

        Returns:
            The same fields and `seen`. Colour and elevation of unobserved cells, and the
            slopes next to them, are the training mean. Other layers are NaN in these
            cells, and `class_id` is unlabelled.
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
        """Return noisy colours, and the mean colour in unobserved cells."""
        noisy = rgb + self.masking.colour_noise * noise
        colour = noisy.round().clamp(0, 255).to(rgb.dtype)
        mean = torch.tensor(self.means["rgb"]).round().to(rgb.dtype)
        return torch.where(seen[:, None], colour, mean[:, None, None])

    def _mask_slope(self, slope: Tensor, seen: Tensor) -> Tensor:
        """Return slopes, and the mean slope where a neighbouring cell is unobserved."""
        unseen = (~seen).float()
        near_unseen = torch.nn.functional.max_pool2d(unseen, 3, stride=1, padding=1) > 0
        return torch.where(near_unseen, self.means["slope_deg"][0], slope)


def path_distances(path: Tensor, shape: tuple[int, int], resolution_m: float) -> Tensor:
    """Return the distances of cells to straight paths.

    Args:
        path: start (x, y) and end (x, y) as fractions of the map's sides, and the
            driven fraction of the path, shape [b, 5].
        shape: (H, W).
        resolution_m: cell width in metres.

    Returns:
        Metres from the cell centres, float64, shape [b, H, W].
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
        seeds: a number in (0, 1) per map, shape [b].
        is_masked: bool, shape [b, 1, 1].
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
