"""A model that predicts λ from the slope only."""

import torch

from benchnav import Observation, TraversabilityMixture
from benchnav.models import TraversabilityModel


class SlopeModel(TraversabilityModel):
    """Model in which λ falls linearly with the slope; the image is ignored.

    Args:
        fall: decrease of λ per degree of slope.
        std: standard deviation of λ.
    """

    def __init__(self, fall: float = 0.03, std: float = 0.2) -> None:
        self.fall, self.std = fall, std

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """Return a Gaussian per cell, clipped to [0, 1]; parameters are [B, 1, H, W]."""
        mean = (1 - self.fall * observation.slope_deg).unsqueeze(1)
        return TraversabilityMixture(
            torch.ones_like(mean), mean, torch.full_like(mean, self.std)
        )
