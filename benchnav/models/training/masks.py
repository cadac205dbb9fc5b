"""Random masks of training maps, so that a network learns to tell ground of which it
sees a part.

A masked map is what a robot has seen that drove a straight path on it with a camera
that looks all around, without what
hides behind hills: cells within a radius of the path, with noise that grows with
distance. What was not seen holds the training mean, as the map of a robot does
(`benchnav.planning.sensing`). Losses and measures count seen cells alone: of the others
a network could learn no more than how frequent classes are, which the statistics of the
ground say better.
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
    """Masks maps.

    Args:
        law: how.
        means: of the training maps, by layer, as `GroundStatistics` has them.
        resolution_m: cell width.
    """

    law: Masking
    means: Mapping[str, tuple[float, ...]]
    resolution_m: float

    def apply(self, maps: Mapping[str, Tensor], look: Tensor) -> dict[str, Tensor]:
        """Masks a batch.

        Args:
            maps: by field, each of shape [b, *, H, W]; with `slope_deg` there has to be
                `elevation_m`.
            look: uniform numbers of each map: whether it is masked, the radius, both
                ends of the path (x, y), how much of it was driven, and the seed of its
                noise; float64, shape [b, 8].

        Returns:
            The same fields and `seen`. Colour and elevation that were not seen are the
            training mean, and so are slopes next to them; other layers are NaN there,
            and what is learned is unknown.
        """
        height, width = next(iter(maps.values())).shape[-2:]
        distance = path_distances(look[:, 2:7], (height, width), self.resolution_m)
        low, high = self.law.radius_m
        radius = low * (high / low) ** look[:, 1]
        masked = (look[:, 0] < self.law.share)[:, None, None]
        seen = ~masked | (distance <= radius[:, None, None])
        spread = torch.where(masked, distance, 0).float()
        noise = spread[:, None] * _normal(look[:, 7], masked, (4, height, width))
        found: dict[str, Tensor] = {SEEN: seen.float()}
        for name, layer in maps.items():
            if name == "rgb":
                colour = (
                    (layer + self.law.colour_noise * noise[:, :3])
                    .round()
                    .clamp(0, 255)
                    .to(layer.dtype)
                )
                mean = torch.tensor(self.means[name]).round().to(layer.dtype)
                found[name] = torch.where(seen[:, None], colour, mean[:, None, None])
            elif name == "elevation_m":
                noisy = layer + self.law.elevation_noise * noise[:, 3]
                found[name] = torch.where(seen, noisy, self.means[name][0])
                if "slope_deg" in maps:
                    steep = torch.from_numpy(
                        slopes_deg(noisy.numpy(), self.resolution_m)
                    ).to(noisy)
                    slopes = torch.where(masked, steep, maps["slope_deg"])
                    unsure = (
                        torch.nn.functional.max_pool2d(
                            (~seen).float(), 3, stride=1, padding=1
                        )
                        > 0
                    )
                    found["slope_deg"] = torch.where(
                        unsure, self.means["slope_deg"][0], slopes
                    )
            elif name not in ("slope_deg", SEEN):
                unknown = UNLABELLED if name == "class_id" else torch.nan
                found[name] = torch.where(seen, layer, unknown).to(layer.dtype)
        return found


def path_distances(path: Tensor, shape: tuple[int, int], resolution_m: float) -> Tensor:
    """Distances of cells to straight paths.

    Args:
        path: start (x, y) and end (x, y) as shares of the map's sides, and the share of
            the way that was driven, shape [b, 5].
        shape: (H, W).
        resolution_m: cell width.

    Returns:
        Metres from the centres of the cells, float64, shape [b, H, W].
    """
    rows, columns = (
        (torch.arange(size, dtype=torch.float64) + 0.5) * resolution_m for size in shape
    )
    extent = resolution_m * torch.tensor([shape[1], shape[0]], dtype=torch.float64)
    start, way = (
        path[:, :2] * extent,
        (path[:, 2:4] - path[:, :2]) * extent * path[:, 4:],
    )
    (x0, y0), (along_x, along_y) = (ends.T[..., None, None] for ends in (start, way))
    from_x, from_y = columns - x0, rows[:, None] - y0
    length = (along_x**2 + along_y**2).clamp(min=1e-12)
    at = ((from_x * along_x + from_y * along_y) / length).clamp(0, 1)
    return torch.hypot(from_x - at * along_x, from_y - at * along_y)


def _normal(seeds: Tensor, masked: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Standard normals of each map by its own seed, a number in (0, 1), shape [b,
    *shape]; 0 of maps without noise.
    """
    drawn = [
        torch.randn(shape, generator=rng.generator(int(seed * 2**53)))
        if bool(wanted)
        else torch.zeros(shape)
        for seed, wanted in zip(seeds.tolist(), masked, strict=True)
    ]
    return torch.stack(drawn)
