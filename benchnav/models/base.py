"""What a model is: the base classes of models, and the one way to ask any of them for a
prediction.

A model sees an `Observation` and gives a `TraversabilityDistribution`; privileged
models alone are given the
Terrain. Source: paper III-B. Letters in shapes: M members, B maps, H×W cells, C
classes.
"""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Collection
from typing import Any, TypeGuard

import torch
from torch import Tensor

from benchnav.core.device import exact_convolutions
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError, expect
from benchnav.core.ground import SEEN
from benchnav.core.specified import Specified
from benchnav.core.terrain import Observation, Terrain
from benchnav.models.checkpoint import Checkpoint


class TraversabilityModel(Specified, ABC):
    """The base class of models; `benchnav.testing.check_model` tries whether one keeps
    its contract.
    """

    class_names: tuple[str, ...] = ()
    """Classes in the order of their ids, of a model that tells them:
    `class_probabilities` of its predictions are theirs."""

    @abstractmethod
    def predict(self, observation: Observation) -> TraversabilityDistribution:
        """Predicts the distribution of traversability in every cell.

        Args:
            observation: B maps of any size; nothing else is to be known of them.

        Returns:
            The distribution, of shape [B, H, W], on the observation's device: a
            `TraversabilityMixture`, a `QuantileDistribution`, or any other.
        """

    def member_probabilities(self, observation: Observation) -> Tensor | None:
        """Class probabilities of each member of an ensemble, which is calibrated as a
        whole.

        Args:
            observation: B maps of any size.

        Returns:
            Shape [M, B, C, H, W]; M = 1 for a single classifier. None, the default,
            where there are none.
        """
        return None


class ModelFamily(TraversabilityModel):
    """The base class of models that are kept in checkpoints, under the name by which
    the class is registered.
    """

    @classmethod
    @abstractmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> "ModelFamily":
        """Rebuilds a model; what it raises ends in one line, where `load_model` calls
        it.

        Raises:
            CheckpointError: a part is missing.
        """


class PrivilegedModel(TraversabilityModel):
    """The base class of this package's models that are given the truth, to tell what
    failures come from.
    """

    @abstractmethod
    def predict_terrain(self, terrain: Terrain) -> TraversabilityDistribution:
        """As `predict`, from the truth."""

    def predict(self, observation: Observation) -> TraversabilityDistribution:
        """Refuses: what a privileged model knows is in no observation."""
        raise ConfigError(
            f"Expected the Terrain for the privileged model {type(self).__name__}, "
            "got an Observation. "
            "Call `benchnav.models.predict`."
        )


def is_family(target: Any) -> TypeGuard[type[ModelFamily]]:
    """Tells a class whose models are kept in checkpoints from one that is made with
    options.
    """
    return inspect.isclass(target) and issubclass(target, ModelFamily)


def layers_of(observation: Observation, names: Collection[str]) -> dict[str, Tensor]:
    """The layers of an observation that a model was trained on, by name.

    The layer `seen`, for models that declare it, is 1 everywhere where the observation
    does not say what was seen.

    Raises:
        ConfigError: the maps lack one.
    """
    known = {
        "rgb": observation.rgb,
        "elevation_m": observation.elevation_m,
        "slope_deg": observation.slope_deg,
        **observation.layers,
    }
    if SEEN in names and SEEN not in known:
        known[SEEN] = torch.ones_like(observation.elevation_m, dtype=torch.float32)
    lacking = [name for name in names if name not in known]
    expect(
        not lacking,
        f"maps with the layers that the model was trained on, {' and '.join(lacking)} "
        "among them, got "
        f"{', '.join(known)}. Take a dataset that has them.",
    )
    return {name: known[name] for name in names}


def predict(
    model: TraversabilityModel, terrain: Terrain, observation: Observation | None = None
) -> TraversabilityDistribution:
    """Lets a model predict: the privileged ones from the Terrain, every other from its
    Observation alone.

    Args:
        model: any model.
        terrain: B maps.
        observation: what is seen of them; all where it is not given.

    Returns:
        The distribution, of shape [B, H, W].

    Raises:
        ConfigError: the model's answer does not fit the maps.
    """
    if isinstance(model, PrivilegedModel):
        return model.predict_terrain(terrain)
    return predict_observation(
        model, terrain.observe() if observation is None else observation
    )


def predict_observation(
    model: TraversabilityModel, observation: Observation
) -> TraversabilityDistribution:
    """As `predict`, where the truth is not at hand; refuses privileged models."""
    with exact_convolutions():
        predicted: Any = model.predict(observation)
    shape, got = (
        [len(observation.rgb), *observation.grid.shape],
        type(predicted).__name__,
    )
    if isinstance(predicted, TraversabilityDistribution):
        if list(predicted.shape) == shape:
            return predicted
        got += f" of shape {list(predicted.shape)}"
    raise ConfigError(
        f"Expected the model to give a TraversabilityDistribution of shape {shape}, "
        f"got {got}. "
        "Return a TraversabilityMixture, a QuantileDistribution or a subclass of your "
        "own."
    )
