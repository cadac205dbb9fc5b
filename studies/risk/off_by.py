"""Shipped model with scaled weights of soft spots, for docs/studies/risk.md."""

from dataclasses import replace

from benchnav import Observation, TraversabilityMixture
from benchnav.models import TraversabilityModel, load_model


class OffBy(TraversabilityModel):
    """Shipped model that over- or underestimates the weight of soft spots.

    Args:
        factor: factor on the weight of soft spots within each class.
    """

    def __init__(self, factor: float = 1.0) -> None:
        """Load the shipped model."""
        self.model = load_model("stakes-v1")
        self.factor = factor

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """Return the shipped model's prediction with scaled weights."""
        mixture = self.model.predict(observation)
        assert mixture.group is not None
        classes = len(self.model.class_names)
        weights = mixture.weights.clone()
        for k in range(classes, weights.shape[1]):  # soft spots follow the classes
            more = (self.factor - 1) * mixture.weights[:, k]
            weights[:, k] += more
            weights[:, mixture.group[k]] -= more
        return replace(mixture, weights=weights)
