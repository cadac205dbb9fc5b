"""Base classes of models, and prediction by any of them.

A model receives an `Observation` and returns a `TraversabilityDistribution`. Only
privileged models receive the Terrain. Source: paper III-B. Letters in shapes: M
members, B maps, H×W cells, C classes.
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
    """Base class of models; `benchnav.testing.check_model` checks the contract."""

    class_names: tuple[str, ...] = ()
    """Class names in the order of their ids, for a model whose predictions have
    `class_probabilities`; otherwise empty."""

    @abstractmethod
    def predict(self, observation: Observation) -> TraversabilityDistribution:
        """Predict the distribution of traversability in each cell.

        Args:
            observation: B maps of any size, the only information on them.

        Returns:
            The distribution, of shape [B, H, W], on the observation's device: a
            `TraversabilityMixture`, a `QuantileDistribution`, or any other.
        """

    def member_probabilities(self, observation: Observation) -> Tensor | None:
        """Return class probabilities of each member of an ensemble.

        The ensemble is calibrated as a whole.

        Args:
            observation: B maps of any size.

        Returns:
            Shape [M, B, C, H, W]; M = 1 for a single classifier. None, the default, for a
            model without classifiers.
        """
        return None


class ModelFamily(TraversabilityModel):
    """Base class of models stored in checkpoints, under the registered name of the class."""

    @classmethod
    @abstractmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> "ModelFamily":
        """Rebuild a model.

        `load_model` reports exceptions of this method in one line.

        Raises:
            CheckpointError: If a part is missing.
        """


class PrivilegedModel(TraversabilityModel):
    """Base class of the models of this package that receive the truth.

    They serve as references, to attribute failures.
    """

    @abstractmethod
    def predict_terrain(self, terrain: Terrain) -> TraversabilityDistribution:
        """Predict as `predict`, from the truth."""

    def predict(self, observation: Observation) -> TraversabilityDistribution:
        """Raise an error: an observation does not contain the truth.

        Raises:
            ConfigError: Always.
        """
        raise ConfigError(
            f"Expected the Terrain for the privileged model {type(self).__name__}, got an "
            "Observation. Call `benchnav.models.predict`."
        )


def is_family(target: Any) -> TypeGuard[type[ModelFamily]]:
    """Return whether a class builds models from checkpoints, not from options."""
    return inspect.isclass(target) and issubclass(target, ModelFamily)


def layers_of(observation: Observation, names: Collection[str]) -> dict[str, Tensor]:
    """Return the layers of an observation that a model needs, by name.

    If the observation has no layer `seen`, all cells are taken as observed.

    Raises:
        ConfigError: If a layer is missing.
    """
    layers = {
        "rgb": observation.rgb,
        "elevation_m": observation.elevation_m,
        "slope_deg": observation.slope_deg,
        **observation.layers,
    }
    if SEEN in names and SEEN not in layers:
        layers[SEEN] = torch.ones_like(observation.elevation_m, dtype=torch.float32)
    missing = [name for name in names if name not in layers]
    expect(
        not missing,
        f"maps with the layers that the model was trained on, {' and '.join(missing)} "
        f"among them, got {', '.join(layers)}. Use a dataset that has them.",
    )
    return {name: layers[name] for name in names}


def predict(
    model: TraversabilityModel, terrain: Terrain, observation: Observation | None = None
) -> TraversabilityDistribution:
    """Predict maps: privileged models from the Terrain, others from its Observation.

    Args:
        model: any model.
        terrain: B maps.
        observation: observation of the maps; by default all cells are observed.

    Returns:
        The distribution, of shape [B, H, W].

    Raises:
        ConfigError: If the prediction has the wrong type or shape.
    """
    if isinstance(model, PrivilegedModel):
        return model.predict_terrain(terrain)
    if observation is None:
        observation = terrain.observe()
    return predict_observation(model, observation)


def predict_observation(
    model: TraversabilityModel, observation: Observation
) -> TraversabilityDistribution:
    """Predict maps from an observation only; privileged models raise an error."""
    with exact_convolutions():
        predicted: Any = model.predict(observation)
    shape = [len(observation.rgb), *observation.grid.shape]
    got = type(predicted).__name__
    if isinstance(predicted, TraversabilityDistribution):
        if list(predicted.shape) == shape:
            return predicted
        got += f" of shape {list(predicted.shape)}"
    raise ConfigError(
        f"Expected the model to give a TraversabilityDistribution of shape {shape}, "
        f"got {got}. Return a TraversabilityMixture, a QuantileDistribution or a "
        "custom subclass."
    )
