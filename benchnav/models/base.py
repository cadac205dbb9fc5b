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

        These probabilities are not calibrated together; calibration applies to their
        average.

        Args:
            observation: B maps of any size.

        Returns:
            Shape [M, B, C, H, W]; M = 1 for a single classifier. None, the default, for a
            model without classifiers.
        """
        return None


class ModelFamily(TraversabilityModel):
    """Base class of models that checkpoints store under the class's registered name."""

    @classmethod
    @abstractmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> "ModelFamily":
        """Rebuild a model from a checkpoint.

        `load_model` reports exceptions of this method in one line.

        Raises:
            CheckpointError: If a part of the checkpoint is missing.
        """


class PrivilegedModel(TraversabilityModel):
    """Base class of the models of this package that receive the truth.

    As references, they show which failures are due to errors of prediction.
    """

    @abstractmethod
    def predict_terrain(self, terrain: Terrain) -> TraversabilityDistribution:
        """Return the distribution of λ from the true terrain, shape [B, H, W]."""

    def predict(self, observation: Observation) -> TraversabilityDistribution:
        """Raise an error: an observation does not contain the truth.

        Raises:
            ConfigError: Always.
        """
        raise ConfigError(
            f"Expected the Terrain for the privileged model {type(self).__name__}, got an "
            "Observation. Call `benchnav.models.predict` with the Terrain."
        )


def is_family(target: Any) -> TypeGuard[type[ModelFamily]]:
    """Return whether a class builds models from checkpoints, not from options."""
    return inspect.isclass(target) and issubclass(target, ModelFamily)


def layers_of(observation: Observation, names: Collection[str]) -> dict[str, Tensor]:
    """Return the layers of an observation that a model needs, by name.

    If the observation has no layer `seen`, all cells count as observed.

    Raises:
        ConfigError: If the observation lacks a layer.
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
        f"maps with the layers {' and '.join(missing)}, got maps with "
        f"{', '.join(layers)}. The model was trained on the missing layers. Use a "
        "dataset that has them.",
    )
    return {name: layers[name] for name in names}


def predict(
    model: TraversabilityModel, terrain: Terrain, observation: Observation | None = None
) -> TraversabilityDistribution:
    """Return a model's prediction for maps; only privileged models receive the Terrain.

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
    """Return a prediction from an observation; privileged models raise an error."""
    with exact_convolutions():
        predicted: Any = model.predict(observation)
    shape = [len(observation.rgb), *observation.grid.shape]
    description = type(predicted).__name__
    if isinstance(predicted, TraversabilityDistribution):
        if list(predicted.shape) == shape:
            return predicted
        description += f" of shape {list(predicted.shape)}"
    raise ConfigError(
        "Expected the model to return a TraversabilityDistribution of shape "
        f"{shape}, got {description}. Return a TraversabilityMixture, a "
        "QuantileDistribution or a custom subclass."
    )
