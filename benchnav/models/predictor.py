"""What a model is, how it is found by name, and the two that come with the package.

A model sees an `Observation` and gives a `TraversabilityMixture`; the oracle alone is given the
Terrain. A user's own model is registered with `register_model` or by an entry point of the group
`benchnav.models`. Source: paper III-B, equation (1). Letters in shapes: B maps, H×W cells, C
classes, K components.
"""

import difflib
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from benchnav.errors import BenchnavError, CheckpointError, ConfigError
from benchnav.mixture import TraversabilityMixture
from benchnav.models.checkpoint import CLASSIFIER, CONFIG, GP, Checkpoint, load_checkpoint
from benchnav.models.slope_table import SlopeTable
from benchnav.terrain import Observation, Terrain

CHUNK_CELLS = 2**17


class Model(Protocol):
    """The contract of a traversability model."""

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """Predicts the distribution of traversability in every cell.

        Args:
            observation: B maps; nothing else is to be known of them.

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


class Oracle:
    """Knows the true distribution; crossed with a planner it shows what is left without model error."""

    def predict_terrain(self, terrain: Terrain) -> TraversabilityMixture:
        """Gives the true N(f_c(ψ), σ_c) of every cell, K = 1."""
        mean, std = terrain.traversability_mean.unsqueeze(1), terrain.traversability_std.unsqueeze(1)
        return TraversabilityMixture(torch.ones_like(mean), mean.clone(), std.clone())


class FusedModel:
    """The paper's model: class probabilities of a classifier times the GPs of the classes.

    P(λ) = Σ_c P(c)·P_c(λ | ψ), equation (1), with one component a class. Its `single-class` option is
    `TraversabilityMixture.most_likely` of the prediction.

    Args:
        classifier: from uint8 images [B, 3, H, W] to logits [B, C, H, W].
        table: the GPs over slope.
        class_names: names of the C classes.
    """

    def __init__(self, classifier: nn.Module, table: SlopeTable, class_names: tuple[str, ...]) -> None:
        """Sets the classifier to evaluation."""
        if len(class_names) != len(table.mean):
            raise ConfigError(f"Expected a GP for each of {len(class_names)} classes, got {len(table.mean)}.")
        self.classifier, self.table, self.class_names = classifier.eval(), table, class_names

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """Predicts on the observation's device, to which the classifier is moved.

        Args:
            observation: B maps of any size.

        Returns:
            Mixture with float32 parameters of shape [B, C, H, W].
        """
        device, (height, width) = observation.rgb.device, observation.grid.shape
        self.classifier.to(device)
        batch, classes = len(observation.rgb), len(self.class_names)
        weights = torch.empty(batch, classes, height, width, device=device)
        step = max(1, CHUNK_CELLS // (height * width))
        with torch.inference_mode():
            for start in range(0, batch, step):
                logits = self.classifier(observation.rgb[start : start + step])
                if logits.shape[1] != classes:
                    raise ConfigError(f"Expected {classes} classes of the classifier, got {logits.shape[1]}.")
                weights[start : start + step] = logits.float().softmax(1)
        means, stds = self.table.lookup(observation.slope_deg.float())
        return TraversabilityMixture(weights, means, stds)

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> "FusedModel":
        """Rebuilds the model from a checkpoint with both halves.

        Raises:
            CheckpointError: a half is missing, or its tensors do not fit its settings.
        """
        from benchnav.models.classifier import TerrainClassifier

        parts = {name: checkpoint.part(name) for name in (CLASSIFIER, GP)}
        names, tensors = checkpoint.class_names, parts[GP].tensors
        try:
            classifier = TerrainClassifier.from_tensors(
                parts[CLASSIFIER].config, len(names), parts[CLASSIFIER].tensors
            )
            table = SlopeTable(**{name: tensors[name] for name in ("mean", "std", "noise_std")})
            return cls(classifier, table, names)
        except (BenchnavError, KeyError, RuntimeError) as error:
            raise CheckpointError(
                f"Expected tensors that fit the checkpoint's settings, got: {error}. Train the model again."
            ) from error


AnyModel = Model | Oracle
Factory = Callable[[], AnyModel]

_FACTORIES: dict[str, Factory] = {"oracle": Oracle}


def register_model(name: str, factory: Factory) -> None:
    """Makes a model known by name in this process.

    Args:
        name: what suites and commands call it.
        factory: makes the model.
    """
    _FACTORIES[name] = factory


def model_names() -> list[str]:
    """Names that `load_model` knows, besides checkpoints."""
    return sorted({*_FACTORIES, *(point.name for point in entry_points(group="benchnav.models"))})


def load_model(source: str | Path, device: torch.device | str = "cpu") -> AnyModel:
    """Finds a model by registered name or by checkpoint.

    Args:
        source: a registered name such as `oracle`; or the folder of a checkpoint, by path or by its
            name in `checkpoints/` here or in this checkout.
        device: where its parameters are put; prediction follows the observation.

    Raises:
        ConfigError: there is no such model.
        CheckpointError: the checkpoint cannot be used.
    """
    name = str(source)
    if name in _FACTORIES:
        return _FACTORIES[name]()
    for point in entry_points(group="benchnav.models", name=name):
        return point.load()()
    model = FusedModel.from_checkpoint(load_checkpoint(find_checkpoint(source)))
    model.classifier.to(device)
    return model


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


def _cell_shape(weights: Tensor) -> tuple[int, ...]:
    return (*weights.shape[:-3], *weights.shape[-2:])
