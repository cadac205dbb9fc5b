"""Class-wise GPs as tables over slope, which models read instead of evaluating the GPs.

The tables are linear between nodes. For a function g the error is at most h²/8·max|g''|,
with step h = 0.1°. `tabulation_error` in the tests bounds |g''|, and so the error, by
the parameters of the GPs: below 10⁻⁴ for the GPs of the shipped maps. Letters in shapes:
C classes, G nodes, *B any leading dimensions, H×W cells, K components.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from benchnav.core.errors import expect
from benchnav.core.mixture import TraversabilityMixture

STEP_DEG = 0.1
STEEPEST_DEG = 90.0


def table_slopes() -> Tensor:
    """Return the nodes 0°, 0.1°, …, 90°, float64, shape [G]."""
    n_nodes = round(STEEPEST_DEG / STEP_DEG) + 1
    return torch.linspace(0, STEEPEST_DEG, n_nodes, dtype=torch.float64)


class SoftModes(NamedTuple):
    """A second mode of each class's traversability, independent of slope.

    Args:
        weight: fraction of the class's cells in the mode, in [0, 1); 0 for a class without
            a second mode; shape [C].
        mean: mean λ of the mode before clipping, shape [C].
        std: standard deviation of the mode before clipping, > 0, shape [C].
    """

    weight: Tensor
    mean: Tensor
    std: Tensor


@dataclass(frozen=True, kw_only=True)
class SlopeTable:
    """Mean and spread of each class's traversability, before clipping, at the nodes.

    Args:
        mean: latent mean, shape [C, G].
        std: standard deviation of latent function plus noise, > 0, shape [C, G].
        noise_std: standard deviation of the noise only, shape [C].
        soft: the second modes; None if no class has one.
    """

    mean: Tensor
    std: Tensor
    noise_std: Tensor
    soft: SoftModes | None = None

    def __post_init__(self) -> None:
        """Check shapes and values."""
        tensors = self.to_tensors().values()
        is_finite = all(bool(values.isfinite().all()) for values in tensors)
        is_positive = is_finite and bool((self.std > 0).all())
        n_nodes = len(table_slopes())
        expect(
            is_positive and self.mean.shape[1:] == (n_nodes,),
            f"finite tables of the GPs over {n_nodes} slopes with `std` > 0, got "
            f"tables of shape {list(self.mean.shape)} or with other values. Train the "
            "GPs again.",
        )

    def lookup(self, slope_deg: Tensor) -> tuple[Tensor, Tensor]:
        """Return the main mode of every class at the slope of each cell.

        Args:
            slope_deg: slopes in degrees, clamped to [0, 90], shape [*B, H, W].

        Returns:
            Means and standard deviations, each of shape [*B, C, H, W], with the dtype and
            device of the slopes.
        """
        mean, std = self._read(slice(None), slope_deg)
        return mean.movedim(0, -3), std.movedim(0, -3)

    def predict_by_class(
        self, class_id: Tensor, slope_deg: Tensor
    ) -> TraversabilityMixture:
        """Return the prediction for each cell from its class and slope.

        Args:
            class_id: class of each cell, int64, shape [*B, H, W].
            slope_deg: slopes in degrees, clamped to [0, 90], shape [*B, H, W].

        Returns:
            A mixture with parameters of shape [*B, K, H, W]: K = 2 if any class has a
            second mode, otherwise 1.
        """
        mean, std = self._read(class_id, slope_deg)
        if self.soft is None:
            weights = torch.ones_like(mean).unsqueeze(-3)
            means = mean.unsqueeze(-3)
            stds = std.unsqueeze(-3)
            return TraversabilityMixture(weights, means, stds, (0,))
        soft = SoftModes(*(values.to(slope_deg)[class_id] for values in self.soft))
        weights = torch.stack([1 - soft.weight, soft.weight], -3)
        means = torch.stack([mean, soft.mean], -3)
        stds = torch.stack([std, soft.std], -3)
        return TraversabilityMixture(weights, means, stds, (0, 0))

    def to_tensors(self) -> dict[str, Tensor]:
        """Return the tables by name, for a checkpoint."""
        tables = {name: values for name, values in vars(self).items() if name != "soft"}
        soft = self.soft._asdict() if self.soft else {}
        return tables | {f"soft_{name}": values for name, values in soft.items()}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> "SlopeTable":
        """Rebuild a table from the result of `to_tensors`.

        Raises:
            KeyError: If a tensor is missing.
            ConfigError: If the tensors are not valid tables.
        """
        soft = None
        if "soft_weight" in tensors:
            soft = SoftModes(*(tensors[f"soft_{name}"] for name in SoftModes._fields))
        return cls(
            mean=tensors["mean"],
            std=tensors["std"],
            noise_std=tensors["noise_std"],
            soft=soft,
        )

    def _read(
        self, classes: Tensor | slice, slope_deg: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return means and standard deviations, interpolated between adjacent nodes."""
        last_node = self.mean.shape[1] - 1
        position = (slope_deg / STEP_DEG).clamp(0, last_node)
        lower = position.floor().clamp(max=last_node - 1)
        node = lower.long()

        def interpolate(table: Tensor) -> Tensor:
            rows = table.to(slope_deg)
            fraction = (position - lower).to(rows.dtype)
            return torch.lerp(rows[classes, node], rows[classes, node + 1], fraction)

        return interpolate(self.mean), interpolate(self.std)
