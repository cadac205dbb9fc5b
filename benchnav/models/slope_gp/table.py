"""The class-wise GPs as tables over slope: what prediction reads instead of computing them again.

Between nodes the tables are linear; for a function g that is off by at most h²/8·max|g''| on the
step h = 0.1°. `tabulation_error` in the tests bounds |g''|, and with it the error, from the parameters
of the GPs: under 10⁻⁴ for those fitted to the shipped maps, and growing with h². Letters in shapes: C
classes, G nodes, *B any leading dimensions, H×W cells.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture

STEP_DEG = 0.1
STEEPEST_DEG = 90.0


def table_slopes() -> Tensor:
    """The nodes 0°, 0.1°, …, 90°, float64, shape [G]."""
    return torch.linspace(0, STEEPEST_DEG, round(STEEPEST_DEG / STEP_DEG) + 1, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True)
class SoftModes:
    """A second mode of each class's traversability, the same at any slope.

    Args:
        weight: share of the class's cells, in [0, 1), 0 for a class without one; shape [C].
        mean: λ there before clipping, shape [C].
        std: its standard deviation, > 0, shape [C].
    """

    weight: Tensor
    mean: Tensor
    std: Tensor

    def __post_init__(self) -> None:
        """Checks shapes and values."""
        if not self.weight.shape == self.mean.shape == self.std.shape:
            raise ConfigError(
                "Expected `weight`, `mean` and `std` of soft modes of one shape [C], got "
                f"{list(self.weight.shape)}, {list(self.mean.shape)} and {list(self.std.shape)}."
            )
        shares = (self.weight >= 0) & (self.weight < 1)
        if not bool((shares & self.mean.isfinite() & self.std.isfinite() & (self.std > 0)).all()):
            raise ConfigError(
                "Expected soft modes of `weight` in [0, 1), finite `mean` and `std` > 0, got others."
            )

    def to(self, device: torch.device | str) -> "SoftModes":
        """Copies them to `device`."""
        return SoftModes(weight=self.weight.to(device), mean=self.mean.to(device), std=self.std.to(device))


@dataclass(frozen=True, kw_only=True)
class SlopeTable:
    """Mean and spread of each class's traversability, before clipping, at the nodes.

    Args:
        mean: latent mean, shape [C, G].
        std: of the latent function and the noise together, shape [C, G].
        noise_std: of the noise alone, shape [C].
        soft: the second modes; None where no class has one.
    """

    mean: Tensor
    std: Tensor
    noise_std: Tensor
    soft: SoftModes | None = None

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
        if self.soft is not None and len(self.soft.weight) != wanted[0]:
            raise ConfigError(f"Expected soft modes of {wanted[0]} classes, got {len(self.soft.weight)}.")

    def lookup(self, slope_deg: Tensor) -> tuple[Tensor, Tensor]:
        """Reads every class at each cell's slope; of a class with a second mode the main one.

        Args:
            slope_deg: in [0, 90]; beyond is read at the nearer end, shape [*B, H, W].

        Returns:
            Means and standard deviations, dtype and device of the slopes, each [*B, C, H, W].
        """
        node, share = self._place(slope_deg)
        values = []
        for table in (self.mean, self.std):
            rows = table.to(slope_deg)
            low, high = rows[:, node], rows[:, node + 1]
            values.append(torch.lerp(low, high, share.to(low.dtype)).movedim(0, -3))
        return values[0], values[1]

    def own(self, class_id: Tensor, slope_deg: Tensor) -> TraversabilityMixture:
        """Reads each cell with its own class.

        Args:
            class_id: int64, shape [*B, H, W].
            slope_deg: in [0, 90]; beyond is read at the nearer end, shape [*B, H, W].

        Returns:
            Parameters of shape [*B, K, H, W]: K = 1, or 2 where classes have second modes.
        """
        node, share = self._place(slope_deg)
        read = []
        for table in (self.mean, self.std):
            rows = table.to(slope_deg)
            low, high = rows[class_id, node], rows[class_id, node + 1]
            read.append(torch.lerp(low, high, share.to(low.dtype)))
        mean, std = read
        if self.soft is None:
            whole = torch.ones_like(mean).unsqueeze(-3)
            return TraversabilityMixture(whole, mean.unsqueeze(-3), std.unsqueeze(-3), (0,))
        soft = self.soft
        weight, soft_mean, soft_std = (v.to(slope_deg)[class_id] for v in (soft.weight, soft.mean, soft.std))
        pairs = ((1 - weight, weight), (mean, soft_mean), (std, soft_std))
        weights, means, stds = (torch.stack(pair, -3) for pair in pairs)
        return TraversabilityMixture(weights, means, stds, (0, 0))

    def to(self, device: torch.device | str) -> "SlopeTable":
        """Copies the tables to `device`."""
        return SlopeTable(
            mean=self.mean.to(device),
            std=self.std.to(device),
            noise_std=self.noise_std.to(device),
            soft=None if self.soft is None else self.soft.to(device),
        )

    def to_tensors(self) -> dict[str, Tensor]:
        """Gives the tables by name, for a checkpoint."""
        tables = {"mean": self.mean, "std": self.std, "noise_std": self.noise_std}
        if self.soft is None:
            return tables
        return {
            **tables,
            "soft_weight": self.soft.weight,
            "soft_mean": self.soft.mean,
            "soft_std": self.soft.std,
        }

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> "SlopeTable":
        """Rebuilds the tables of `to_tensors`.

        Raises:
            KeyError: one is missing.
            ConfigError: they are no tables.
        """
        soft = None
        if "soft_weight" in tensors:
            soft = SoftModes(
                weight=tensors["soft_weight"], mean=tensors["soft_mean"], std=tensors["soft_std"]
            )
        return cls(mean=tensors["mean"], std=tensors["std"], noise_std=tensors["noise_std"], soft=soft)

    def _place(self, slope_deg: Tensor) -> tuple[Tensor, Tensor]:
        """The node under each slope, and how far on to the next it is."""
        place = (slope_deg / STEP_DEG).clamp(0, self.mean.shape[1] - 1)
        left = place.floor().clamp(max=self.mean.shape[1] - 2)
        return left.long(), place - left
