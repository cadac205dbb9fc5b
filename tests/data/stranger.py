"""An evidential U-Net on colour, elevation and vegetation, as a stranger would write it
(Amini et al., 2020).
"""

from collections.abc import Callable
from dataclasses import dataclass

import segmentation_models_pytorch as smp
import torch
from torch import Tensor, nn

from benchnav import TraversabilityMixture
from benchnav.models import TrainableModel, TrainingConfig


@dataclass(frozen=True, kw_only=True)
class Config(TrainingConfig):
    inputs: tuple[str, ...] = ("rgb", "elevation_m", "vegetation_m")
    regulariser: float = 0.1
    max_epochs: int = 3


class Evidential(TrainableModel):
    def __init__(self, config: Config = Config()) -> None:
        super().__init__(config)

    stride = 32

    def configure_network(self, channels: int) -> nn.Module:
        return smp.Unet(
            "resnet18", encoder_weights=None, in_channels=channels, classes=4
        )

    def configure_losses(self) -> Callable[[Tensor, Tensor], Tensor]:
        return self.evidential_loss

    def evidential_loss(self, outputs: Tensor, observed: Tensor) -> Tensor:
        gamma, nu, alpha, beta = parameters(outputs)
        seen = observed.isfinite()
        y = torch.where(seen, observed, gamma.detach())
        omega = 2 * beta * (1 + nu)
        nll = (
            0.5 * (torch.pi / nu).log()
            - alpha * omega.log()
            + (alpha + 0.5) * ((y - gamma) ** 2 * nu + omega).log()
            + alpha.lgamma()
            - (alpha + 0.5).lgamma()
        )
        return (
            (nll + self.config.regulariser * (y - gamma).abs() * (2 * nu + alpha))
            * seen
        ).sum() / seen.sum()

    def to_distribution(self, outputs: Tensor) -> TraversabilityMixture:
        gamma, nu, alpha, beta = (v.unsqueeze(1) for v in parameters(outputs))
        std = (beta * (1 + 1 / nu) / (alpha - 1)).sqrt()
        return TraversabilityMixture(torch.ones_like(gamma), gamma, std)


def parameters(outputs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    gamma, nu, alpha, beta = outputs.unbind(1)
    soft = nn.functional.softplus
    return gamma, soft(nu) + 1e-3, soft(alpha) + 1.01, soft(beta) + 1e-3
