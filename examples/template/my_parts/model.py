"""A model that looks at the slope alone."""

import torch

from benchnav import Observation, TraversabilityMixture
from benchnav.models import TraversabilityModel


class SlopeModel(TraversabilityModel):
    """λ falls with slope, whatever the ground looks like.

    Args:
        fall: by how much λ falls with a degree of slope.
        std: how far λ may be off.
    """

    def __init__(self, fall: float = 0.03, std: float = 0.2) -> None:
        self.fall, self.std = fall, std

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """One Gaussian in each cell, clipped to [0, 1]: weights, means and deviations
        of shape [B, K = 1, H, W].
        """
        mean = (1 - self.fall * observation.slope_deg).unsqueeze(1)
        return TraversabilityMixture(
            torch.ones_like(mean), mean, torch.full_like(mean, self.std)
        )
