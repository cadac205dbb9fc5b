"""Loading of models by name or checkpoint, and the privileged models.

Models are parts of the registry (`benchnav.core.registry`, kind `model`). A registered
object is either a function or class that returns a model from options, or a family
whose `from_checkpoint` rebuilds the models of checkpoints that name it. The models of
this package are registered in the same way. Letters in shapes: K components.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import nn

from benchnav.core import registry
from benchnav.core.command import tell
from benchnav.core.describe import describe, name_object
from benchnav.core.errors import (
    CheckpointError,
    ConfigError,
    expect,
    out_of_memory_error,
)
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.registry import Found, Part
from benchnav.core.sources import digest_of
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.ground import TRAIN, find_ground, ground_file
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.models.base import PrivilegedModel, TraversabilityModel, is_family
from benchnav.models.checkpoint import (
    CONFIG,
    FUSED,
    Checkpoint,
    digests_of,
    load_checkpoint,
    read_config,
    read_ground,
)
from benchnav.models.checkpoint_folders import (
    find_checkpoint,
    list_checkpoints,
    split_class_and_checkpoint,
)
from benchnav.models.conformal import ConformalModel, ConformalTable
from benchnav.models.parts import CLASSIFIER, check_finished


class Oracle(PrivilegedModel):
    """Predicts the true distribution of each cell's class; only noise is unknown."""

    def predict_terrain(self, terrain: Terrain) -> TraversabilityMixture:
        """Return the true distribution of each cell."""
        return terrain.truth


class Ideal(PrivilegedModel):
    """Predicts the best distribution given colours: the mixture over look-alike classes.

    The difference between a model and Ideal is the model's error. The difference
    between Ideal and Oracle is due to what images do not show. Look-alike classes have
    equal weights, so the single-class option selects the first of them in the class
    table.
    """

    def predict_terrain(self, terrain: Terrain) -> TraversabilityMixture:
        """Return the mixture of the true distributions of each cell's look-alike classes."""
        if terrain.look_alikes is None:
            return terrain.truth
        return terrain.look_alikes(terrain)


class Clairvoyant(PrivilegedModel):
    """Predicts the realised λ, so that only planning can fail."""

    def predict_terrain(self, terrain: Terrain) -> TraversabilityMixture:
        """Return the realised λ of each cell as a point mass, K = 1."""
        means = terrain.traversability.unsqueeze(1)
        return TraversabilityMixture(
            torch.ones_like(means), means, torch.zeros_like(means), (0,)
        )


_SOURCE = "_source"  # attribute with the part from which a model was loaded
Source = str | Path | Mapping[str, Any] | Part
# `CovarianceModel.nugget` for trained models, measured in docs/reference/sensing.md. With
# a nugget of 0, prediction errors make the scores of neighbouring cells contradict each
# other.
MODEL_NUGGET = 0.1


@dataclass(frozen=True, kw_only=True)
class ModelPart(Part):
    """Description of a model: a part of the registry, or a checkpoint.

    A checkpoint may be given together with the class that rebuilds it.
    """

    kind: str = field(default="model", compare=False, repr=False)

    @property
    def folder(self) -> Path | None:
        """Folder of the checkpoint; None for a part of the registry.

        Registered names take precedence over folders.
        """
        if self.part in registry.names("model"):
            return None
        is_code = ":" in self.part or self.part.endswith(".py")
        is_folder = (Path(self.part) / CONFIG).is_file()
        if is_code and not is_folder and split_class_and_checkpoint(self.part) is None:
            return None
        folder = find_checkpoint(self.part)
        expect(
            not self.options,
            f"no options for the checkpoint {self.part!r}, got {dict(self.options)}. "
            "Leave them out.",
        )
        return folder

    @property
    def found(self) -> Found:
        """The class or function that creates the model or rebuilds its checkpoint."""
        folder = self.folder
        if folder is None:
            return registry.find("model", self.part)
        class_and_checkpoint = split_class_and_checkpoint(self.part)
        if class_and_checkpoint:
            return registry.find("model", class_and_checkpoint[0])
        return find_family(read_config(folder)["model"])

    @property
    def key(self) -> str:
        """The description as JSON, with digests of code and files; key for `loaded`."""
        folder = self.folder
        files = digests_of(folder) if folder else registry.option_files(self)
        content = [self.part, dict(self.options), self.found.digest, files]
        return json.dumps(content, sort_keys=True)

    @property
    def object(self) -> TraversabilityModel:
        """The model; the two used last are cached until their code or files change."""
        return loaded(self.key)

    def create(self, **arguments: Any) -> TraversabilityModel:
        """Load the model; see `load_model`."""
        return load_model(self)


@lru_cache(maxsize=2)
def loaded(key: str) -> TraversabilityModel:
    """Return the model for a `ModelPart.key`; the two used last are cached."""
    part, options, *_ = json.loads(key)
    return load_model(ModelPart(part=part, label="", options=options))


def read_model(source: Source) -> ModelPart:
    """Read the description of a model as users write it; see `load_model`.

    Raises:
        ConfigError: If the description is not a text, a path or a mapping with a part.
    """
    if isinstance(source, ModelPart):
        return source
    if isinstance(source, Path):
        source = str(source)
    part = registry.read_part("model", source)
    return ModelPart(part=part.part, label=part.label, options=part.options)


@torch.inference_mode(False)  # so that the caller's mode does not affect the model
def load_model(source: Source) -> TraversabilityModel:
    """Load a model from a checkpoint or from the registry.

    The model predicts on the observation's device.

    Args:
        source: a checkpoint, given by the path of its folder, by its name in
            `checkpoints/` of the working directory or among the shipped checkpoints, or
            as `owner/name@revision` of a hub; or a part of the registry, such as
            `oracle`, `package.module:Name` or `path/to/file.py:Name`, with options in a
            mapping; or a checkpoint with its custom class,
            `path/to/file.py:Name@CHECKPOINT`.

    Raises:
        ConfigError: If the model does not exist or rejects its options.
        CheckpointError: If the checkpoint cannot be used.
    """
    part = read_model(source)
    family = part.found
    folder = part.folder
    if folder is not None:
        model = open_checkpoint(_checked_checkpoint(part, folder, family), family)
    elif is_family(family.target):
        raise no_checkpoint_error(part)
    else:
        model = registry.make("model", part)
    # Frozen models reject attributes, and networks would register them.
    object.__setattr__(model, _SOURCE, part)
    return model


def no_checkpoint_error(part: ModelPart) -> ConfigError:
    """Return the error for a family of models that is given instead of a model."""
    same_name = [path for path in list_checkpoints() if path.name == part.part]
    remedy = "name or path, or as FILE.py:Class@CHECKPOINT for a custom class"
    if same_name:
        remedy = f"path: {same_name[0]}"
    return ConfigError(
        f"Expected a model, got {part.part!r}, which is a family of models. Give a "
        f"checkpoint of this family by its {remedy}."
    )


def describe_model(model: Any) -> Part:
    """Return the part that loads a model; see `benchnav.core.describe.describe`.

    Args:
        model: a model, or an argument of `load_model`.

    Returns:
        The part that loads a model with the same weights. If the model was trained in
        this process or changed after loading, the part is valid only in this process.

    Raises:
        ConfigError: If the argument is not a model.
    """
    if isinstance(model, str | Path | Mapping | Part):
        return read_model(model)
    part = getattr(model, _SOURCE, None)
    if part is None:
        return describe("model", model)
    if _digest_of_weights(load_model(part)) == _digest_of_weights(model):
        return part
    return name_object("model", model)


def _digest_of_weights(model: TraversabilityModel) -> str:
    contents = (
        tensor.detach().cpu().contiguous().numpy().tobytes()
        for network in networks_of(model)
        for tensor in network.state_dict().values()
    )
    return digest_of(contents)


def networks_of(value: Any) -> Iterator[nn.Module]:
    """Yield the networks of a model and of its members."""
    if isinstance(value, nn.Module):
        yield value
    elif isinstance(value, TraversabilityModel):
        yield from networks_of(vars(value))
    elif isinstance(value, Mapping):
        yield from networks_of(list(value.values()))
    elif isinstance(value, list | tuple):
        for member in value:
            yield from networks_of(member)


def _checked_checkpoint(part: ModelPart, folder: Path, family: Found) -> Checkpoint:
    """Read a checkpoint, and check that it is finished and matches the given class.

    Raises:
        ConfigError: If the given class cannot rebuild checkpoints.
        CheckpointError: If the checkpoint is unfinished or has another class.
    """
    class_and_checkpoint = split_class_and_checkpoint(part.part)
    if class_and_checkpoint and not is_family(family.target):
        raise ConfigError(
            f"Expected {class_and_checkpoint[0]} to be a subclass of "
            "benchnav.models.TrainableModel or ModelFamily, got another class or a "
            "function. Only such subclasses have checkpoints."
        )
    checkpoint = load_checkpoint(folder)
    if class_and_checkpoint:
        if checkpoint.model != family.target.__name__:
            raise CheckpointError(
                f"Expected a checkpoint of the class {family.target.__name__}, got "
                f"{folder}, which is of the class {checkpoint.model!r}. Give the class "
                "with which it was trained."
            )
    elif checkpoint.model == FUSED and CLASSIFIER not in checkpoint.parts:
        check_finished(folder, checkpoint.parts)
    return checkpoint


def find_family(name: str) -> Found:
    """Find the family that a checkpoint names.

    Only registered names are accepted, never a module or file, so that a checkpoint
    cannot run arbitrary code.

    Raises:
        CheckpointError: If the name is not registered.
    """
    options = registry.names("model")
    family = registry.find("model", name) if name in options else None
    if family is None or not is_family(family.target):
        raise CheckpointError(
            f"Expected a checkpoint of a model among {', '.join(options)}, got a "
            f"checkpoint of {name!r}. Install the package that registers {name!r}, or "
            f"give the class of the model: path/to/file.py:{name}@CHECKPOINT."
        )
    return family


def open_checkpoint(
    checkpoint: Checkpoint, family: Found | None = None
) -> TraversabilityModel:
    """Rebuild the model of a checkpoint, and warn if the code of its class changed.

    Args:
        checkpoint: content of the checkpoint.
        family: class that rebuilds the model; None for the class that the checkpoint
            names.

    Raises:
        CheckpointError: If the family is not registered, or cannot rebuild the model.
    """
    family = family or find_family(checkpoint.model)
    if checkpoint.code and checkpoint.code != family.digest:
        tell(
            f"benchnav: warning: {checkpoint.model} in {family.origin} has changed "
            f"since it trained the checkpoint (digest {family.digest[:12]} instead of "
            f"{checkpoint.code[:12]}), so its predictions may differ"
        )
    try:
        model = family.target.from_checkpoint(checkpoint)
        if not checkpoint.conformal:
            return model
        return ConformalModel(model, ConformalTable.read(checkpoint.conformal))
    except CheckpointError:
        raise
    except Exception as error:  # a custom class may raise any error
        raise out_of_memory_error(error) or CheckpointError(
            f"Expected tensors that fit the settings of the {checkpoint.model} "
            f"checkpoint, got: {str(error)[:300]}. Train the model again."
        ) from error


def trained_on(source: Source) -> dict[str, str]:
    """Return the maps on which a checkpoint was trained.

    Args:
        source: argument of `load_model`.

    Returns:
        Name of split and dataset, such as "train of paper-v1", by digest of the split;
        empty if the model has no checkpoint.
    """
    folder = read_model(source).folder
    if not folder:
        return {}
    names = {}
    for part in read_config(folder)["parts"].values():
        for entry in part["data"]["digest"].split(","):
            split, _, digest = entry.partition(":")
            names[digest] = f"{split} of {part['data']['id']}"
    return names


def nugget_of(model: TraversabilityModel) -> float:
    """Return `CovarianceModel.nugget` for a model; 0 if it predicts the truth."""
    return 0.0 if isinstance(model, Oracle | Clairvoyant) else MODEL_NUGGET


def find_ground_statistics(source: Source, dataset: TerrainDataset) -> GroundStatistics:
    """Return the terrain statistics for the initial belief.

    Args:
        source: argument of `load_model`. The statistics of a checkpoint are those of
            its training maps.
        dataset: maps of the evaluation. If the model has no statistics, they are read
            from the file next to the dataset, or else from the shipped recipe of its
            maps.

    Raises:
        ConfigError: If there are no statistics.
        CheckpointError: If the statistics of the checkpoint are damaged.
    """
    folder = read_model(source).folder
    statistics = read_ground(folder, read_config(folder)) if folder else None
    statistics = statistics or find_ground(dataset)
    if statistics is None:
        path = ground_file(dataset.path)
        arguments = f"TRAINING_DATA --out {path}"
        if TRAIN in dataset.splits:
            arguments = f"{dataset.path}"
        raise ConfigError(
            f"Expected statistics of the ground in {path}, got none. Compute them "
            f"from maps of the split {TRAIN} with `benchnav-datagen ground {arguments}`."
        )
    return statistics


def class_mismatch(
    model: TraversabilityModel | Checkpoint, recipe: Recipe, name: str = "the model"
) -> str:
    """Return a line that compares a model's classes with the data's if they differ.

    Args:
        model: a model, or a checkpoint, which has class names even if its model predicts
            no classes.
        recipe: recipe of the data.
        name: name of the model in the line.

    Returns:
        The line; empty if the classes are equal or the model has no class names.
    """
    names = tuple(item.name for item in recipe.classes)
    if model.class_names in ((), names):
        return ""
    return (
        f"{name} was trained on other classes than those of {recipe.id}: "
        f"{', '.join(model.class_names)}; the maps have "
        f"{', '.join(names)}"
    )
