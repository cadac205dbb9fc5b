"""A custom traversability model: a small network and its loss, trained by a command.

    benchnav-train fit examples/own_model.py:CellModel --data DATASET --out checkpoints/mine --members 3
    benchnav-train evaluate examples/own_model.py:CellModel@checkpoints/mine --data DATASET
    benchnav-eval run --model examples/own_model.py:CellModel@checkpoints/mine --data DATASET

The network predicts a Gaussian, clipped to [0, 1], from a single cell's `inputs`. The
loss is the continuous ranked probability score (Gneiting and Raftery, 2007).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from benchnav import TraversabilityMixture
from benchnav.models import TrainableModel, TrainingConfig


@dataclass(frozen=True, kw_only=True)
class CellConfig(TrainingConfig):
    """Settings of the model, such as `--settings.hidden 64` or `--settings.inputs [rgb]`.

    Args:
        inputs: layers of the observation that the network reads.
        hidden: number of hidden channels.
        least_std: minimum standard deviation of λ.
        max_epochs: number of training epochs.
    """

    inputs: tuple[str, ...] = ("rgb", "slope_deg")
    hidden: int = 32
    least_std: float = 0.02
    max_epochs: int = 30


class CellModel(TrainableModel):
    def __init__(self, config: CellConfig = CellConfig()) -> None:
        super().__init__(config)

    def configure_network(self, channels: int) -> nn.Module:
        hidden = self.config.hidden
        return nn.Sequential(
            nn.Conv2d(channels, hidden, 1), nn.SiLU(), nn.Conv2d(hidden, 2, 1)
        )

    def configure_losses(self) -> Callable[[Tensor, Tensor], Tensor]:
        def crps(outputs: Tensor, observed: Tensor) -> Tensor:
            mean, std = self.gaussian(outputs)
            seen = observed.isfinite()  # λ is NaN where it was not observed
            z = (torch.where(seen, observed, 0.5) - mean) / std
            density = torch.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
            scores = std * (
                z * torch.erf(z / math.sqrt(2)) + 2 * density - 1 / math.sqrt(math.pi)
            )
            return (scores * seen).sum() / seen.sum().clamp(min=1)

        return crps

    def to_distribution(self, outputs: Tensor) -> TraversabilityMixture:
        # [B, K = 1, H, W]
        mean, std = (values.unsqueeze(1) for values in self.gaussian(outputs))
        return TraversabilityMixture(torch.ones_like(mean), mean, std)

    def gaussian(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        mean, width = outputs.unbind(1)
        return mean, nn.functional.softplus(width) + self.config.least_std
