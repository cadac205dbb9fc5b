"""What a model is, and how it is found by name or by checkpoint.

A model sees an `Observation` and gives a `TraversabilityMixture`; the oracle alone is given the
Terrain. Models are found by name through `register_model` or an entry point of the group
`benchnav.models`; what stands there is either called without arguments and makes a model, or is a
family, with `from_checkpoint`, for checkpoints that bear its name. The package's own models use the
same group. Source: paper III-B. Letters in shapes: M members, B maps, H×W cells, C classes, K
components.
"""

import difflib
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from benchnav.errors import CheckpointError, ConfigError
from benchnav.mixture import TraversabilityMixture
from benchnav.models.checkpoint import CONFIG, Checkpoint, load_checkpoint
from benchnav.terrain import Observation, Terrain

GROUP = "benchnav.models"


class Model(Protocol):
    """The contract of a traversability model, which `benchnav.models.contract.check_model` tries."""

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """Predicts the distribution of traversability in every cell.

        Args:
            observation: B maps of any size; nothing else is to be known of them.

        Returns:
            Mixture with parameters of shape [B, K, H, W], on the observation's device.
        """
        ...


@runtime_checkable
class ClassModel(Model, Protocol):
    """A model whose components are terrain classes, so that its weights are class probabilities.

    Args:
        class_names: names of the classes, in the order of the components.
    """

    class_names: tuple[str, ...]


@runtime_checkable
class EnsembleModel(ClassModel, Protocol):
    """A model whose class probabilities are the average of its members'."""

    def member_probabilities(self, observation: Observation) -> Tensor:
        """Class probabilities of each member, shape [M, B, C, H, W]; M = 1 for a single classifier."""
        ...


@runtime_checkable
class ModelFamily(Protocol):
    """Models of one make that are kept in checkpoints under its name."""

    def from_checkpoint(self, checkpoint: Checkpoint) -> Model:
        """Rebuilds a model.

        Raises:
            CheckpointError: a part is missing, or its tensors do not fit its settings.
        """
        ...


class Oracle:
    """Knows the true distribution; crossed with a planner it shows what is left without model error."""

    def predict_terrain(self, terrain: Terrain) -> TraversabilityMixture:
        """Gives the true N(f_c(ψ), σ_c) of every cell, K = 1."""
        mean, std = terrain.traversability_mean.unsqueeze(1), terrain.traversability_std.unsqueeze(1)
        return TraversabilityMixture(torch.ones_like(mean), mean.clone(), std.clone())


AnyModel = Model | Oracle
Registered = Callable[[], AnyModel] | ModelFamily

_REGISTERED: dict[str, Registered] = {}


def register_model(name: str, model: Registered) -> None:
    """Makes a model or a family known by name in this process.

    Args:
        name: what suites, commands and checkpoints call it.
        model: makes a model when called without arguments, or has `from_checkpoint`.
    """
    _REGISTERED[name] = model


def model_names() -> list[str]:
    """Registered names of models and families."""
    return sorted({*_REGISTERED, *(point.name for point in entry_points(group=GROUP))})


def load_model(source: str | Path) -> AnyModel:
    """Finds a model by registered name or by checkpoint; it predicts on the observation's device.

    Args:
        source: a registered name such as `oracle`; or the folder of a checkpoint, by path or by its
            name in `checkpoints/` here or in this checkout.

    Raises:
        ConfigError: there is no such model.
        CheckpointError: the checkpoint cannot be used.
    """
    found = _find_registered(str(source))
    if found is None:
        return open_checkpoint(load_checkpoint(find_checkpoint(source)))
    if isinstance(found, ModelFamily):
        raise ConfigError(
            f"Expected a model, got {str(source)!r}, which is a family of models. "
            "Name a checkpoint of it, by its path if it bears the same name."
        )
    return found()


def open_checkpoint(checkpoint: Checkpoint) -> Model:
    """Rebuilds the model of a checkpoint through the family that it names.

    Raises:
        CheckpointError: the family is not registered here, or cannot rebuild the model.
    """
    family = _find_registered(checkpoint.model)
    if not isinstance(family, ModelFamily):
        raise CheckpointError(
            f"Expected a checkpoint of a model among {', '.join(model_names())}, got one of "
            f"{checkpoint.model!r}. Install the package that registers it."
        )
    return family.from_checkpoint(checkpoint)


def find_checkpoint(source: str | Path) -> Path:
    """Finds the folder of a checkpoint by path, or by name in `checkpoints/` here and in this checkout.

    Raises:
        CheckpointError: the folder holds no checkpoint.
        ConfigError: there is no such folder, nor a model of that name.
    """
    folders = [Path("checkpoints"), Path(__file__).parents[2] / "checkpoints"]
    for path in (Path(source), *(folder / source for folder in folders)):
        if (path / CONFIG).is_file():
            return path
    if Path(source).is_dir():
        return Path(source)  # to be refused by the reader, which says what is missing there
    known = sorted({*model_names(), *(path.parent.name for f in folders for path in f.glob(f"*/{CONFIG}"))})
    close = difflib.get_close_matches(str(source), known, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    raise ConfigError(
        f"Expected a model among {', '.join(known)} or the folder of a checkpoint, got {str(source)!r}.{hint}"
    )


def predict(model: AnyModel, terrain: Terrain) -> TraversabilityMixture:
    """Lets a model predict: the oracle from the Terrain, every other from its Observation alone.

    Args:
        model: any model.
        terrain: B maps.

    Returns:
        Mixture with parameters of shape [B, K, H, W].

    Raises:
        ConfigError: the model's answer does not fit the maps.
    """
    if isinstance(model, Oracle):
        return model.predict_terrain(terrain)
    mixture: Any = model.predict(terrain.observe())
    shape = (len(terrain), *terrain.grid.shape)
    if not isinstance(mixture, TraversabilityMixture) or _cell_shape(mixture.weights) != shape:
        got = (
            list(mixture.weights.shape)
            if isinstance(mixture, TraversabilityMixture)
            else type(mixture).__name__
        )
        raise ConfigError(
            "Expected the model to give a TraversabilityMixture of shape "
            f"[{shape[0]}, K, {shape[1]}, {shape[2]}], got {got}."
        )
    return mixture


def _find_registered(name: str) -> Registered | None:
    if name in _REGISTERED:
        return _REGISTERED[name]
    for point in entry_points(group=GROUP, name=name):
        return point.load()
    return None


def _cell_shape(weights: Tensor) -> tuple[int, ...]:
    return (*weights.shape[:-3], *weights.shape[-2:])
