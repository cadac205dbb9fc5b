"""The class-wise GPs as tables over slope: what prediction reads instead of computing them again.

Between nodes the tables are linear; for a function g that is off by at most h²/8·max|g''| on the
step h = 0.1°. `LatentGPs.tabulation_error` bounds |g''|, and with it the error, from the parameters
of the GPs: under 10⁻⁴ for those fitted to the shipped maps, and growing with h². Letters in shapes: C
classes, G nodes, *B any leading dimensions, H×W cells.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.errors import ConfigError

STEP_DEG = 0.1
STEEPEST_DEG = 90.0


def table_slopes() -> Tensor:
    """The nodes 0°, 0.1°, …, 90°, float64, shape [G]."""
    return torch.linspace(0, STEEPEST_DEG, round(STEEPEST_DEG / STEP_DEG) + 1, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True)
class SlopeTable:
    """Mean and spread of each class's traversability, before clipping, at the nodes.

    Args:
        mean: latent mean, shape [C, G].
        std: of the latent function and the noise together, shape [C, G].
        noise_std: of the noise alone, shape [C].
    """

    mean: Tensor
    std: Tensor
    noise_std: Tensor

    def __post_init__(self) -> None:
        """Checks shapes and values."""
        wanted = (len(self.noise_std), len(table_slopes()))
        if not self.mean.shape == self.std.shape == wanted:
            raise ConfigError(
                f"Expected `mean` and `std` of shape {list(wanted)}, "
                f"got {list(self.mean.shape)} and {list(self.std.shape)}."
            )
        if not bool(self.mean.isfinite().all() and self.std.isfinite().all() and (self.std > 0).all()):
            raise ConfigError("Expected finite `mean` and finite `std` > 0, got others.")

    def lookup(self, slope_deg: Tensor) -> tuple[Tensor, Tensor]:
        """Reads every class at each cell's slope.

        Args:
            slope_deg: in [0, 90]; beyond is read at the nearer end, shape [*B, H, W].

        Returns:
            Means and standard deviations, dtype and device of the slopes, each [*B, C, H, W].
        """
        place = (slope_deg / STEP_DEG).clamp(0, self.mean.shape[1] - 1)
        left = place.floor().clamp(max=self.mean.shape[1] - 2)
        share, node = place - left, left.long()
        values = []
        for table in (self.mean, self.std):
            rows = table.to(slope_deg)
            low, high = rows[:, node], rows[:, node + 1]
            values.append(torch.lerp(low, high, share.to(low.dtype)).movedim(0, -3))
        return values[0], values[1]

    def to(self, device: torch.device | str) -> "SlopeTable":
        """Copies the tables to `device`."""
        return SlopeTable(
            mean=self.mean.to(device), std=self.std.to(device), noise_std=self.noise_std.to(device)
        )
