"""What a model is: the base classes of models, and the one way to ask any of them for a prediction.

A model sees an `Observation` and gives a `TraversabilityMixture`; privileged models alone are given the
Terrain. Source: paper III-B. Letters in shapes: M members, B maps, H×W cells, C classes, K components.
"""

import inspect
from abc import ABC, abstractmethod
from typing import Any, TypeGuard

from torch import Tensor

from benchnav.core.device import exact_convolutions
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation, Terrain
from benchnav.models.checkpoint import Checkpoint


class TraversabilityModel(ABC):
    """The base class of models; `benchnav.testing.check_model` tries whether one keeps its contract."""

    class_names: tuple[str, ...] = ()
    """Classes in the order of their ids, of a model that tells them: its weights, summed by `group`, are their
    probabilities."""

    @abstractmethod
    def predict(self, observation: Observation) -> TraversabilityMixture:
        """Predicts the distribution of traversability in every cell.

        Args:
            observation: B maps of any size; nothing else is to be known of them.

        Returns:
            Mixture with parameters of shape [B, K, H, W], on the observation's device.
        """

    def member_probabilities(self, observation: Observation) -> Tensor | None:
        """Class probabilities of each member of an ensemble, which is calibrated as a whole.

        Args:
            observation: B maps of any size.

        Returns:
            Shape [M, B, C, H, W]; M = 1 for a single classifier. None, the default, where there are none.
        """
        return None


class ModelFamily(TraversabilityModel):
    """The base class of models that are kept in checkpoints, under the name by which the class is registered."""

    @classmethod
    @abstractmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> "ModelFamily":
        """Rebuilds a model; what it raises ends in one line, where `load_model` calls it.

        Raises:
            CheckpointError: a part is missing.
        """


class PrivilegedModel(TraversabilityModel):
    """The base class of this package's models that are given the truth, to tell what failures come from."""

    @abstractmethod
    def predict_terrain(self, terrain: Terrain) -> TraversabilityMixture:
        """As `predict`, from the truth."""

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """Refuses: what a privileged model knows is in no observation."""
        raise ConfigError(
            f"Expected the Terrain for the privileged model {type(self).__name__}, got an Observation. "
            "Call `benchnav.models.predict`."
        )


def is_family(target: Any) -> TypeGuard[type[ModelFamily]]:
    """Tells a class whose models are kept in checkpoints from one that is made with options."""
    return inspect.isclass(target) and issubclass(target, ModelFamily)


def predict(model: TraversabilityModel, terrain: Terrain) -> TraversabilityMixture:
    """Lets a model predict: the privileged ones from the Terrain, every other from its Observation alone.

    Args:
        model: any model.
        terrain: B maps.

    Returns:
        Mixture with parameters of shape [B, K, H, W].

    Raises:
        ConfigError: the model's answer does not fit the maps.
    """
    if isinstance(model, PrivilegedModel):
        return model.predict_terrain(terrain)
    return predict_observation(model, terrain.observe())


def predict_observation(model: TraversabilityModel, observation: Observation) -> TraversabilityMixture:
    """As `predict`, where the truth is not at hand; refuses privileged models."""
    with exact_convolutions():
        mixture: Any = model.predict(observation)
    maps, (height, width) = len(observation.rgb), observation.grid.shape
    got: Any = type(mixture).__name__
    if isinstance(mixture, TraversabilityMixture):
        got = list(mixture.weights.shape)
        if [*got[:-3], *got[-2:]] == [maps, height, width]:
            return mixture
    raise ConfigError(
        f"Expected the model to give a TraversabilityMixture of shape [{maps}, K, {height}, {width}], "
        f"got {got}."
    )
