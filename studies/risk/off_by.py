"""The shipped model with another weight of soft spots, for docs/studies/risk.md."""

from dataclasses import replace

from benchnav import Observation, TraversabilityMixture
from benchnav.models import TraversabilityModel, load_model


class OffBy(TraversabilityModel):
    """Takes soft spots for more or less of the ground than the shipped model does.

    Args:
        factor: of the weight of each class's soft spots within the class.
    """

    def __init__(self, factor: float = 1.0) -> None:
        """Loads the shipped model."""
        self.model = load_model("stakes-v1")
        self.factor = factor

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """As the shipped model, with other weights."""
        mixture = self.model.predict(observation)
        assert mixture.group is not None
        classes = len(self.model.class_names)
        weights = mixture.weights.clone()
        for k in range(
            classes, weights.shape[1]
        ):  # soft spots stand behind the classes
            more = (self.factor - 1) * mixture.weights[:, k]
            weights[:, k] += more
            weights[:, mixture.group[k]] -= more
        return replace(mixture, weights=weights)
