"""Models that need no training: classes by their colours, and λ as the dataset's own
functions have it.
"""

import torch
from torch import Tensor

from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation
from benchnav.datagen.recipe.classes import TerrainClass
from benchnav.datagen.recipe.load import load_recipe
from benchnav.models.base import TraversabilityModel
from benchnav.models.slope_gp.table import SlopeTable, table_slopes


def true_table(
    classes: tuple[TerrainClass, ...], latent_std: float = 0.03
) -> SlopeTable:
    """The true latent functions with some uncertainty of the latent function added."""
    slopes = table_slopes().float()
    mean = torch.stack(
        [
            (1 - c.scale * 1e-3 * slopes**c.exponent - c.offset).clamp(0, 1)
            for c in classes
        ]
    )
    noise = torch.tensor([c.noise for c in classes])
    std = (noise**2 + latent_std**2).sqrt()[:, None].expand_as(mean)
    return SlopeTable(mean=mean, std=std.contiguous(), noise_std=noise)


class ColourModel(TraversabilityModel):
    """Weighs classes by the distance of their colours, softly, one member a given
    softness.
    """

    def __init__(self, softness: tuple[float, ...] = (30.0, 90.0)) -> None:
        classes = load_recipe("tiny-v1").classes
        self.softness, self.table = softness, true_table(classes)
        self.class_names = tuple(item.name for item in classes)
        self.colours = torch.tensor([item.colour for item in classes]).float()

    def member_probabilities(self, observation: Observation) -> Tensor:
        pixels = observation.rgb.float().unsqueeze(1)
        distance = (
            (pixels - self.colours[None, :, :, None, None]).square().sum(2).sqrt()
        )
        return torch.stack(
            [(-distance / softness).softmax(1) for softness in self.softness]
        )

    def predict(self, observation: Observation) -> TraversabilityMixture:
        mean, std = self.table.lookup(observation.slope_deg)
        return TraversabilityMixture(
            self.member_probabilities(observation).mean(0), mean, std
        )
