"""Ensembles of models, and the temperature by which normal scores are multiplied.

Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Sequence

import torch

from benchnav.core.conditioned import conditioned
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.pooled import pool
from benchnav.core.terrain import Observation
from benchnav.models.base import TraversabilityModel


class Ensemble(TraversabilityModel):
    """Several models as one: the calibrated average of their distribution functions.

    Source: Lakshminarayanan et al. (2017), "Simple and scalable predictive uncertainty
    estimation using deep ensembles".

    Args:
        members: the models.
        temperature: temperature of the average; see `TrainableModel`.
    """

    def __init__(
        self, members: Sequence[TraversabilityModel], temperature: float = 1.0
    ) -> None:
        """Store members and temperature."""
        self.members = tuple(members)
        self.temperature = temperature

    def predict(self, observation: Observation) -> TraversabilityDistribution:
        """Return the average of all members' predictions, of shape [B, H, W]."""
        averaged = pool([member.predict(observation) for member in self.members])
        return widened(averaged, self.temperature)


def widened(
    distribution: TraversabilityDistribution, temperature: float
) -> TraversabilityDistribution:
    """Multiply the normal scores of distributions by a temperature.

    Args:
        distribution: any distribution, shape [B, H, W].
        temperature: > 0; above 1 it widens, at 1 it changes nothing.
    """
    if temperature == 1:
        return distribution
    zeros = torch.zeros(
        distribution.shape, dtype=distribution.dtype, device=distribution.device
    )
    return conditioned(distribution, zeros, zeros + temperature)
