"""How a model is found, by name or by checkpoint, and the privileged ones, which are
given the truth.

Models are parts of the registry (`benchnav.core.registry`, kind `model`): what
stands at a name is either called with its options and makes a model, or is a family,
with `from_checkpoint`, for checkpoints that bear its name. The package's own models are
in the same registry.
Letters in shapes: K components.
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import nn

from benchnav.core import hub, registry
from benchnav.core.command import tell
from benchnav.core.describe import describe, name_object
from benchnav.core.errors import CheckpointError, ConfigError, expect, out_of_memory
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.registry import Found, Part
from benchnav.core.shipped_files import shipped_folder
from benchnav.core.sources import digest_of
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.ground import TRAIN, find_ground, ground_file
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.models.base import PrivilegedModel, TraversabilityModel, is_family
from benchnav.models.checkpoint import (
    CLASSIFIER,
    CONFIG,
    FUSED,
    Checkpoint,
    digests_of,
    load_checkpoint,
    read_config,
    read_ground,
    refuse_unfinished,
)
from benchnav.models.conformal import ConformalModel, ConformalTable


class Oracle(PrivilegedModel):
    """Knows the true distribution of each cell's own class; what is left is noise."""

    def predict_terrain(self, terrain: Terrain) -> TraversabilityMixture:
        """Gives the true distribution of every cell."""
        return terrain.truth


class Ideal(PrivilegedModel):
    """Knows all that colours can tell: of look-alikes, the mixture of their true
    distributions.

    What a model falls short of it is the model's error; what it falls short of the
    oracle cannot be seen. Its look-alikes weigh the same, so that of them the
    single-class option keeps the first of the class table.
    """

    def predict_terrain(self, terrain: Terrain) -> TraversabilityMixture:
        """Gives the true distributions of all classes that look like the cell's own."""
        if terrain.look_alikes is None:
            return terrain.truth
        return terrain.look_alikes(terrain)


class Clairvoyant(PrivilegedModel):
    """Knows the λ that a robot will meet; what is left is planning."""

    def predict_terrain(self, terrain: Terrain) -> TraversabilityMixture:
        """Gives the realised λ of every cell, without doubt, K = 1."""
        means = terrain.traversability.unsqueeze(1)
        return TraversabilityMixture(
            torch.ones_like(means), means, torch.zeros_like(means), (0,)
        )


_SOURCE = "_source"  # attribute that keeps how a model was found
Source = str | Path | Mapping[str, Any] | Part
# `Law.nugget` under a model that learnt; docs/reference/sensing.md has the figures it
# was chosen by. Without a nugget, scores of neighbouring cells that the model predicts
# wrongly contradict each other.
MODEL_NUGGET = 0.1
IN_REPOSITORY_ALONE = "paper-v1"  # a checkpoint that `setup.py` leaves out of wheels


@dataclass(frozen=True, kw_only=True)
class ModelPart(Part):
    """The description of a model: a part of the registry, or a checkpoint, perhaps with
    the class that rebuilds it.
    """

    kind: str = field(default="model", compare=False, repr=False)

    @property
    def folder(self) -> Path | None:
        """Folder of the checkpoint; None for a part of the registry, whose names go
        first.
        """
        is_place = ":" in self.part or self.part.endswith(".py")
        if self.part in registry.names("model"):
            return None
        if (
            is_place
            and split_own(self.part) is None
            and not (Path(self.part) / CONFIG).is_file()
        ):
            return None
        folder = find_checkpoint(self.part)
        expect(
            not self.options,
            f"no options for the checkpoint {self.part!r}, got {dict(self.options)}.",
        )
        return folder

    @property
    def found(self) -> Found:
        """The class or function that creates the model; of a checkpoint the class that
        rebuilds it.
        """
        folder = self.folder
        if folder is None:
            return registry.find("model", self.part)
        own = split_own(self.part)
        return (
            registry.find("model", own[0])
            if own
            else find_family(read_config(folder)["model"])
        )

    @property
    def key(self) -> str:
        """The description as text, with digests of code and files; see `loaded`."""
        folder = self.folder
        files = digests_of(folder) if folder else registry.option_files(self)
        return json.dumps(
            [self.part, dict(self.options), self.found.digest, files], sort_keys=True
        )

    @property
    def object(self) -> TraversabilityModel:
        """The model. A process keeps the last two, as long as their code and files stay
        the same.
        """
        return loaded(self.key)

    def create(self, **given: Any) -> TraversabilityModel:
        """Load the model; see `load_model`."""
        return load_model(self)


@lru_cache(maxsize=2)
def loaded(key: str) -> TraversabilityModel:
    """Return the model of a `ModelPart.key`, which this process keeps."""
    part, options, *_ = json.loads(key)
    return load_model(ModelPart(part=part, label="", options=options))


def read_model(source: Source) -> ModelPart:
    """Read the description of a model as users write it; see `load_model`.

    Raises:
        ConfigError: If it is not a text, a path or a mapping as of a part.
    """
    if isinstance(source, ModelPart):
        return source
    part = registry.read_part(
        "model", str(source) if isinstance(source, Path) else source
    )
    return ModelPart(part=part.part, label=part.label, options=part.options)


@torch.inference_mode(False)  # so that it is the same model wherever it is loaded
def load_model(source: Source) -> TraversabilityModel:
    """Finds a model by checkpoint or as a part of the registry; it predicts on the
    observation's device.

    Args:
        source: the folder of a checkpoint, by path or by its name in `checkpoints/`
            here or among those shipped, or `owner/name@revision` of a hub; or a part,
            such as `oracle`, `package.module:Name` or `path/to/file.py:Name`, with
            options where it is a mapping; or the checkpoint of a class that a file or
            module holds, `path/to/file.py:Name@CHECKPOINT`.

    Raises:
        ConfigError: there is no such model, or it refuses its options.
        CheckpointError: the checkpoint cannot be used.
    """
    part = read_model(source)
    found, folder = part.found, part.folder
    if folder is not None:
        model = open_checkpoint(_checked_checkpoint(part, folder, found), found)
    elif is_family(found.target):
        raise no_model(part)
    else:
        model = registry.make("model", part)
    # A frozen model refuses attributes, and a network takes them for its own.
    object.__setattr__(model, _SOURCE, part)
    return model


def no_model(part: ModelPart) -> ConfigError:
    """Return the error that says what to name in place of a family of models."""
    same_name = next(
        (path for path in list_checkpoints() if path.name == part.part), None
    )
    how = (
        f"path: {same_name}"
        if same_name
        else "name or path, a class of your own as FILE.py:Class@CHECKPOINT"
    )
    return ConfigError(
        f"Expected a model, got {part.part!r}, which is a family of models. Name a "
        f"checkpoint of it, by its {how}."
    )


def describe_model(model: Any) -> Part:
    """Describe a model by what loads it again; see `benchnav.core.describe.describe`.

    Args:
        model: a model, or what `load_model` takes.

    Returns:
        The part that loads a model with the same weights. A model that was trained in
        this process, or changed after it was loaded, is known by a name in this process
        only.

    Raises:
        ConfigError: If it is no model.
    """
    if isinstance(model, str | Path | Mapping | Part):
        return read_model(model)
    part = getattr(model, _SOURCE, None)
    if part is None:
        return describe("model", model)
    return (
        part
        if _digest_of_weights(load_model(part)) == _digest_of_weights(model)
        else name_object("model", model)
    )


def _digest_of_weights(model: TraversabilityModel) -> str:
    tensors = (
        tensor
        for network in networks_of(model)
        for tensor in network.state_dict().values()
    )
    return digest_of(
        tensor.detach().cpu().contiguous().numpy().tobytes() for tensor in tensors
    )


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


def split_own(source: str | Path) -> tuple[str, str] | None:
    """Splits `path/to/file.py:Name@CHECKPOINT` into class and checkpoint; None of what
    is not of this form.
    """
    named = re.fullmatch(r"(.+?:[A-Za-z_][\w.]*)@(.+)", str(source))
    return (
        None
        if named is None or (Path(source) / CONFIG).is_file()
        else (named[1], named[2])
    )


def _checked_checkpoint(part: ModelPart, folder: Path, family: Found) -> Checkpoint:
    """Read a checkpoint that is finished and, where the user names a class, was trained
    with it.
    """
    own = split_own(part.part)
    if own and not is_family(family.target):
        raise ConfigError(
            f"Expected {own[0]} to be a benchnav.models.TrainableModel or "
            "ModelFamily, whose models are kept in "
            "checkpoints, got another class or function."
        )
    checkpoint = load_checkpoint(folder)
    if own and checkpoint.model != family.target.__name__:
        raise CheckpointError(
            f"Expected a checkpoint of the class {family.target.__name__}, got "
            f"{folder}, which is one of "
            f"{checkpoint.model!r}. Name the class that it was trained with."
        )
    if not own and checkpoint.model == FUSED and CLASSIFIER not in checkpoint.parts:
        refuse_unfinished(folder, checkpoint.parts)
    return checkpoint


def find_family(name: str) -> Found:
    """Finds the family that a checkpoint names.

    Names alone are looked up, never a module or file: what a checkpoint says runs no
    code of its choice.

    Raises:
        CheckpointError: it is not known here by name.
    """
    known = registry.names("model")
    found = registry.find("model", name) if name in known else None
    if found is None or not is_family(found.target):
        raise CheckpointError(
            f"Expected a checkpoint of a model among {', '.join(known)}, got one of "
            f"{name!r}. Install the package that "
            f"registers it, or name the class: path/to/file.py:{name}@CHECKPOINT."
        )
    return found


def open_checkpoint(
    checkpoint: Checkpoint, family: Found | None = None
) -> TraversabilityModel:
    """Rebuild the model of a checkpoint, and warn if its class is of other code now.

    Args:
        checkpoint: as it was read.
        family: the class that rebuilds it; None for that which the checkpoint names.

    Raises:
        CheckpointError: If the family is not known here by name, or cannot rebuild the
            model.
    """
    family = family or find_family(checkpoint.model)
    if checkpoint.code and checkpoint.code != family.digest:
        tell(
            f"benchnav: warning: {checkpoint.model} in {family.origin} has changed "
            "since it trained the checkpoint "
            f"(digest {family.digest[:12]}, then {checkpoint.code[:12]}), so that its "
            "predictions may differ"
        )
    try:
        model = family.target.from_checkpoint(checkpoint)
        table = (
            ConformalTable.read(checkpoint.conformal) if checkpoint.conformal else None
        )
        return ConformalModel(model, table) if table else model
    except CheckpointError:
        raise
    except Exception as error:  # a user's class may raise anything
        raise out_of_memory(error) or CheckpointError(
            "Expected tensors that fit the checkpoint's settings, got: "
            f"{str(error)[:300]}. Train the model again."
        ) from error


def find_checkpoint(source: str | Path) -> Path:
    """Finds the folder of a checkpoint by path, by name in `checkpoints/` here or among
    the shipped ones, or on a hub.

    Of `path/to/file.py:Name@CHECKPOINT` it is the folder of CHECKPOINT.

    Raises:
        CheckpointError: the training of the checkpoint was interrupted.
        ConfigError: there is no such folder, nor a model of that name.
    """
    if own := split_own(source):
        source = own[1]
    places = (Path(source), *(folder / source for folder in _checkpoint_folders()))
    for path in places:
        if (path / CONFIG).is_file():
            return path
    if Path(source).is_dir():
        # to be refused by the reader, which says what is missing there
        return Path(source)
    for path in places:
        refuse_unfinished(path)
    if hub.is_address(source):
        return hub.download(str(source), "model", CheckpointError)
    if str(source) == IN_REPOSITORY_ALONE:
        raise ConfigError(
            f"Expected the checkpoint {source} in checkpoints/, got none: the wheel "
            "leaves it out for its size. Copy "
            f"the folder checkpoints/{source} of the repository there, or name "
            "another model, such as stakes-v1."
        )
    path, names = Path(source), [path.name for path in list_checkpoints()]
    known = sorted({*registry.names("model"), *names})
    siblings = [config.parent.name for config in path.parent.glob(f"*/{CONFIG}")]
    near = (
        registry.hint(str(source), known)
        or registry.hint(path.name, siblings, f"{path.parent}/")
        or registry.hint(path.name, names)
    )
    raise ConfigError(
        f"Expected a model among {', '.join(known)}, the folder of a checkpoint, "
        "package.module:Name, "
        "path/to/file.py:Name or owner/name@revision of a hub, got "
        f"{str(source)!r}.{near}"
    )


def list_checkpoints() -> list[Path]:
    """Folders of the checkpoints in `checkpoints/` here and of those shipped; of one
    name the first.
    """
    found: dict[str, Path] = {}
    for folder in _checkpoint_folders():
        for path in sorted(config.parent for config in folder.glob(f"*/{CONFIG}")):
            found.setdefault(path.name, path)
    return list(found.values())


def trained_on(source: Source) -> dict[str, str]:
    """Says which maps a checkpoint was trained on.

    Args:
        source: as `load_model` takes it, which is to have read it.

    Returns:
        By digest of a split its name and that of its dataset, such as "train of
        paper-v1"; empty of what is no checkpoint.
    """
    folder = read_model(source).folder
    found, parts = {}, read_config(folder)["parts"] if folder else {}
    for part in parts.values():
        for entry in part["data"]["digest"].split(","):
            split, _, digest = entry.partition(":")
            found[digest] = f"{split} of {part['data']['id']}"
    return found


def nugget_of(model: TraversabilityModel) -> float:
    """`Law.nugget` under a model's predictions: 0 where they are each cell's true
    distribution.
    """
    return 0.0 if isinstance(model, Oracle | Clairvoyant) else MODEL_NUGGET


def find_ground_statistics(source: Source, dataset: TerrainDataset) -> GroundStatistics:
    """Finds what is known of ground before any of it is seen.

    Args:
        source: as `load_model` takes it. The statistics that a checkpoint brings are
            those of the maps that it was trained on.
        dataset: the maps that are driven on, for models that bring none: the statistics
            beside it, else those of the shipped recipe of its maps.

    Raises:
        ConfigError: there are none.
        CheckpointError: those of the checkpoint are damaged.
    """
    folder = read_model(source).folder
    found = read_ground(folder, read_config(folder)) if folder else None
    found = found or find_ground(dataset)
    if found is None:
        path = ground_file(dataset.path)
        how = (
            f"{dataset.path}"
            if TRAIN in dataset.splits
            else f"TRAINING_DATA --out {path}"
        )
        raise ConfigError(
            f"Expected statistics of the ground in {path}, got none. Make them of "
            f"maps of the split {TRAIN} with "
            f"`benchnav-datagen ground {how}`."
        )
    return found


def class_mismatch(
    model: TraversabilityModel | Checkpoint, recipe: Recipe, name: str = "the model"
) -> str:
    """Tells in one line when a model knows another class table than that of the data.

    Args:
        model: a model, or a checkpoint, which has a class table even where its model
            tells no classes.
        recipe: of the data.
        name: what the line calls the model.

    Returns:
        Empty where the tables are the same, or the model has none.
    """
    names = tuple(item.name for item in recipe.classes)
    if model.class_names in ((), names):
        return ""
    return (
        f"{name} was trained on other classes than those of {recipe.id}: "
        f"{', '.join(model.class_names)}; the maps have "
        f"{', '.join(names)}"
    )


def _checkpoint_folders() -> tuple[Path, Path]:
    return Path("checkpoints"), shipped_folder("checkpoints")
