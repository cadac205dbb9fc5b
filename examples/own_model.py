"""A traversability model of one's own: a small network with a loss of its own, trained as ours are.

    benchnav-train fit examples/own_model.py:CellModel --data DATASET --out checkpoints/mine --members 3
    benchnav-train evaluate examples/own_model.py:CellModel@checkpoints/mine --data DATASET
    benchnav-eval run --model examples/own_model.py:CellModel@checkpoints/mine --data DATASET

The network looks at one cell at a time, at the layers that `inputs` names, and gives one Gaussian, clipped to [0, 1].
Its loss is the β-NLL of Seitzer et al. (2022), "On the pitfalls of heteroscedastic uncertainty estimation".
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from benchnav import TraversabilityMixture
from benchnav.models import TrainableModel, TrainingConfig


@dataclass(frozen=True, kw_only=True)
class CellConfig(TrainingConfig):
    """Each field is a setting: `--settings.hidden 64 --settings.inputs '[rgb, slope_deg, elevation_m]'`."""

    inputs: tuple[str, ...] = ("rgb", "slope_deg")
    hidden: int = 32
    beta: float = 0.5  # 0: the plain likelihood; 1: errors weigh alike wherever they are
    max_epochs: int = 30


class CellModel(TrainableModel):
    def __init__(self, config: CellConfig = CellConfig()) -> None:
        super().__init__(config)

    def configure_network(self, channels: int) -> nn.Module:
        hidden = self.config.hidden
        return nn.Sequential(nn.Conv2d(channels, hidden, 1), nn.SiLU(), nn.Conv2d(hidden, 2, 1))

    def configure_losses(self) -> Callable[[Tensor, Tensor], Tensor]:
        def beta_nll(outputs: Tensor, observed: Tensor) -> Tensor:
            mean, variance = gaussian(outputs)
            seen = observed.isfinite()  # λ is NaN where it was not observed
            error = torch.where(seen, observed, 0.5) - mean
            nll = 0.5 * (variance.log() + error**2 / variance) * variance.detach() ** self.config.beta
            return (nll * seen).sum() / seen.sum().clamp(min=1)

        return beta_nll

    def to_distribution(self, outputs: Tensor) -> TraversabilityMixture:
        mean, variance = (values.unsqueeze(1) for values in gaussian(outputs))  # [B, K = 1, H, W]
        return TraversabilityMixture(torch.ones_like(mean), mean, variance.sqrt())


def gaussian(outputs: Tensor) -> tuple[Tensor, Tensor]:
    mean, width = outputs.unbind(1)
    return mean, nn.functional.softplus(width) + 1e-4
