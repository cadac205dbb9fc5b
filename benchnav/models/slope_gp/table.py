"""The class-wise GPs as tables over slope: what prediction reads instead of computing
them again.

Between nodes the tables are linear; for a function g that is off by at most
h²/8·max|g''| on the step h = 0.1°. `tabulation_error` in the tests bounds |g''|, and
with it the error, from the parameters
of the GPs: under 10⁻⁴ for those fitted to the shipped maps, and growing with h².
Letters in shapes: C classes, G nodes, *B any leading dimensions, H×W cells.
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
    """The nodes 0°, 0.1°, …, 90°, float64, shape [G]."""
    return torch.linspace(
        0, STEEPEST_DEG, round(STEEPEST_DEG / STEP_DEG) + 1, dtype=torch.float64
    )


class SoftModes(NamedTuple):
    """A second mode of each class's traversability, the same at any slope.

    Args:
        weight: share of the class's cells, in [0, 1), 0 for a class without one; shape
            [C].
        mean: λ there before clipping, shape [C].
        std: its standard deviation, > 0, shape [C].
    """

    weight: Tensor
    mean: Tensor
    std: Tensor


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
        is_finite = all(
            bool(values.isfinite().all()) for values in self.to_tensors().values()
        )
        fits = (
            is_finite
            and bool((self.std > 0).all())
            and self.mean.shape[1:] == table_slopes().shape
        )
        expect(
            fits,
            f"finite tables of {len(table_slopes())} slopes and `std` > 0, got others.",
        )

    def lookup(self, slope_deg: Tensor) -> tuple[Tensor, Tensor]:
        """Reads every class at each cell's slope; of a class with a second mode the
        main one.

        Args:
            slope_deg: in [0, 90]; beyond is read at the nearer end, shape [*B, H, W].

        Returns:
            Means and standard deviations, dtype and device of the slopes, each [*B, C,
            H, W].
        """
        mean, std = self._read(slice(None), slope_deg)
        return mean.movedim(0, -3), std.movedim(0, -3)

    def own(self, class_id: Tensor, slope_deg: Tensor) -> TraversabilityMixture:
        """Reads each cell with its own class.

        Args:
            class_id: int64, shape [*B, H, W].
            slope_deg: in [0, 90]; beyond is read at the nearer end, shape [*B, H, W].

        Returns:
            Parameters of shape [*B, K, H, W]: K = 1, or 2 where classes have second
            modes.
        """
        mean, std = self._read(class_id, slope_deg)
        components: list[tuple[Tensor, ...]] = [(torch.ones_like(mean), mean, std)]
        if soft := self.soft:
            weight, *others = (values.to(slope_deg)[class_id] for values in soft)
            components = [(1 - weight, mean, std), (weight, *others)]
        weights, means, stds = (
            torch.stack(values, -3) for values in zip(*components, strict=True)
        )
        return TraversabilityMixture(weights, means, stds, (0,) * len(components))

    def to_tensors(self) -> dict[str, Tensor]:
        """Gives the tables by name, for a checkpoint."""
        tables = {name: values for name, values in vars(self).items() if name != "soft"}
        soft = self.soft._asdict() if self.soft else {}
        return tables | {f"soft_{name}": values for name, values in soft.items()}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> "SlopeTable":
        """Rebuilds the tables of `to_tensors`.

        Raises:
            KeyError: one is missing.
            ConfigError: they are no tables.
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
        """Means and standard deviations of classes, between the node under each slope
        and the next.
        """
        place = (slope_deg / STEP_DEG).clamp(0, self.mean.shape[1] - 1)
        left = place.floor().clamp(max=self.mean.shape[1] - 2)
        node = left.long()
        tables = (table.to(slope_deg) for table in (self.mean, self.std))
        mean, std = (
            torch.lerp(
                rows[classes, node],
                rows[classes, node + 1],
                (place - left).to(rows.dtype),
            )
            for rows in tables
        )
        return mean, std
