"""Checkpoints: a trained model as a folder of data that runs no code when it is read.

`config.json` says what the model is and how each of its parts came to be, and holds its
own SHA-256; a part, such as `classifier` or `gp`, has its tensors in
`PART.safetensors`, whose SHA-256 stands in `config.json`; `ground.json` holds
statistics of the training maps, of which the model itself makes no use. A checkpoint is
written to a folder beside its own and renamed, so that its name never holds half of
one.
"""

import hashlib
import json
import os
import platform
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

import benchnav
from benchnav.core import registry
from benchnav.core.errors import CheckpointError, ConfigError
from benchnav.core.ground import GroundStatistics
from benchnav.core.short_repr import short_repr
from benchnav.core.sources import digest_of_path
from benchnav.core.store import (
    building,
    check_output,
    real_place,
    refuse_taken,
    replacing,
    restore,
    seal,
    sole_writer,
    take_place,
    unseal,
    write_text,
)
from benchnav.models.card import CARD, card_of

FORMAT = "benchnav-checkpoint"
FORMAT_VERSION = (2, 3)
OLDEST_VERSION = (2, 0)
_SEALED = (2, 2)  # from which on config.json holds its own digest
CONFIG, GROUND = "config.json", "ground.json"
FUSED = "fused"
CLASSIFIER, GP = "classifier", "gp"

# of a part; all else is written as it is
_APART = (
    "tensors",
    "data_id",
    "data_digest",
)
_PACKAGES = ("torch", "lightning", "gpytorch", "segmentation-models-pytorch", "numpy")


def _versions() -> dict[str, str]:
    found = {name: version(name) for name in _PACKAGES}
    return {
        "benchnav": benchnav.__version__,
        "python": platform.python_version(),
        **found,
    }


@dataclass(frozen=True, kw_only=True)
class Part:
    """One trained part of a model.

    Args:
        config: settings it is rebuilt from, plain data.
        tensors: weights and tables by name.
        seed: root seed of its training.
        metrics: what was measured after training.
        data_id: name of what it was trained on: a dataset, or a file of slip logs.
        data_digest: content digest of what it was trained on.
        half_precision: store kernels as float16; they are read as float32.
        versions: of the packages that trained it.
        trainer: settings of the trainer on which the outcome depends; None of a part
            that none trained, or of an earlier version.
        conformal: whether every second map of `valid` was kept from it, to be scored in
            the end.
    """

    __repr__ = short_repr

    config: dict[str, Any]
    tensors: dict[str, Tensor]
    seed: int
    metrics: dict[str, float]
    data_id: str
    data_digest: str
    half_precision: bool = False
    versions: Mapping[str, str] = field(default_factory=_versions)
    trainer: Mapping[str, Any] | None = None
    conformal: bool = False


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A trained model.

    Args:
        class_names: names of the C classes, in the order of their ids.
        parts: its parts by name; `gp`, `classifier`, `classifier-2`, … of a fused
            model.
        model: registered name of the family that rebuilds the model; of a user's own
            class, found in a file or module, its name alone.
        pool_temperature: of the average of several members (see
            `models.nets.calibration`); 1 changes nothing.
        code: digest of the code of the class; empty where that is ours.
        conformal: a `models.conformal.ConformalTable` as plain data, by which the whole
            model is recalibrated; empty where it is not.
        ground: statistics of the maps that it was trained on last; None where it was
            trained on none.
    """

    __repr__ = short_repr

    class_names: tuple[str, ...]
    parts: Mapping[str, Part] = field(default_factory=dict)
    model: str = FUSED
    pool_temperature: float = 1.0
    code: str = ""
    conformal: Mapping[str, Any] = field(default_factory=dict)
    ground: GroundStatistics | None = None

    def part(self, name: str) -> Part:
        """Gives a part.

        Raises:
            CheckpointError: it has not been trained.
        """
        if name not in self.parts:
            raise CheckpointError(
                f"Expected a checkpoint with a part {name!r}, got one with "
                f"{sorted(self.parts)}. "
                f"Train it with `benchnav-train {_command(name)}` into the same "
                "folder."
            )
        return self.parts[name]

    def with_part(self, name: str, part: Part) -> "Checkpoint":
        """Gives a copy in which one part is added or replaced; another member makes
        another pool and another model.
        """
        pooled = self.pool_temperature if name == GP else 1.0
        return replace(
            self,
            parts={**self.parts, name: part},
            pool_temperature=pooled,
            conformal={},
        )


def _command(part: str) -> str:
    """The command that trains a part."""
    stem = part.partition("-")[0]
    if stem in (CLASSIFIER, GP):
        return stem
    return (
        f"fit {stem}"
        if stem in registry.names("model")
        else f"fit path/to/file.py:{stem}"
    )


def member_name(index: int, stem: str) -> str:
    """Name of the part that holds a member of an ensemble; members are counted from 0,
    and the first is the stem.
    """
    return f"{stem}-{index + 1}" if index else stem


def is_member(name: str, stem: str) -> bool:
    """Tells whether a part is a member of the name `stem`."""
    return name == stem or (
        name.startswith(f"{stem}-") and name.removeprefix(f"{stem}-").isdigit()
    )


def digests_of(folder: Path) -> dict[str, str]:
    """SHA-256 of each file that predictions depend on, by name: not of the card, nor of
    statistics of the ground.
    """
    kinds = (".json", ".safetensors")
    files = sorted(
        path
        for path in folder.iterdir()
        if path.suffix in kinds and path.name != GROUND
    )
    return {path.name: digest_of_path(path) for path in files}


def member_names(checkpoint: Checkpoint, stem: str) -> list[str]:
    """Names of the members that are there, the first one in any case."""
    names = [member_name(index, stem) for index in range(len(checkpoint.parts))]
    return [name for name in names if name in checkpoint.parts] or [stem]


def as_stored(tensors: Mapping[str, Tensor], half_precision: bool) -> dict[str, Tensor]:
    """Gives tensors as they are read back: those kept as float16 are rounded to it.

    Args:
        tensors: by name.
        half_precision: whether kernels are kept as float16.
    """
    return _as_read(_to_store(tensors, half_precision))


def save_checkpoint(folder: str | Path, checkpoint: Checkpoint) -> None:
    """Writes a checkpoint, replacing one that is there.

    Args:
        folder: its name.
        checkpoint: what to write.

    Raises:
        OSError: it cannot be written.
        ConfigError: the name is that of something else.
        BenchnavError: another process is writing it.
    """
    with sole_writer(Path(folder), str(folder)), open_place(folder) as (place, partial):
        _write(partial, checkpoint, place.name)
        take_place(partial, place, last=CONFIG)


@contextmanager
def open_place(folder: str | Path) -> Iterator[tuple[Path, Path]]:
    """Gives the place that the name of a checkpoint stands for, and an empty folder to
    write it in.

    Raises:
        OSError: it cannot be written.
        ConfigError: the name is that of something else.
    """
    check_output(str(folder))
    # a/../b is b, whether or not there is an a
    place = real_place(Path(os.path.normpath(folder)))
    restore(place)
    refuse_taken(
        place,
        True,
        lambda path: (
            "" if (path / CONFIG).is_file() else "is something else than a checkpoint"
        ),
    )
    with building(place) as partial:
        yield place, partial


def load_checkpoint(folder: str | Path) -> Checkpoint:
    """Reads a checkpoint; tensors are on the CPU, and those stored as float16 are
    float32.

    Raises:
        CheckpointError: it is missing, damaged, or of a newer format.
    """
    folder = Path(folder)
    config = read_config(folder)
    try:
        parts = {
            name: _read_part(folder / f"{name}.safetensors", **entry)
            for name, entry in config["parts"].items()
        }
        names, pooled = (
            config["class_names"],
            float(config.get("pool_temperature", 1.0)),
        )
        if not all(isinstance(name, str) for name in names) or len(set(names)) != len(
            names
        ):
            raise ValueError("class_names are no names of different classes")
        if not 0 < pooled < float("inf"):
            raise ValueError(f"pool_temperature is {pooled}")
        return Checkpoint(
            class_names=tuple(names),
            parts=parts,
            model=config["model"],
            pool_temperature=pooled,
            code=str(config.get("code", "")),
            conformal=dict(config.get("conformal", {})),
            ground=read_ground(folder, config),
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise _damaged(folder / CONFIG, f"{type(error).__name__} {error}") from error


def training_folder(folder: str | Path) -> Path:
    """Where the logs of a training stand, and what it needs to go on: beside its
    checkpoint.
    """
    return Path(f"{os.path.normpath(folder)}.training")


def refuse_unfinished(folder: str | Path, trained: Collection[str] = ()) -> None:
    """Refuses a model whose training was interrupted, with how to go on.

    Args:
        folder: of its checkpoint, whether or not it is there yet.
        trained: names of the parts that the checkpoint holds.

    Raises:
        CheckpointError: a part was begun in the folder of logs that the checkpoint
            lacks.
    """
    logs = training_folder(folder)
    begun = sorted(
        path.name
        for path in logs.glob("*")
        if path.is_dir() and path.name not in trained
    )
    if begun:
        command = "all" if GP in trained else _command(begun[0])
        raise CheckpointError(
            f"Expected a trained model in {folder}, got one whose training was "
            f"interrupted: {logs / begun[0]} is not "
            "finished. Give its command again with --resume, such as "
            f"`benchnav-train {command} --data DATA --out {folder} --resume`."
        )


def read_config(folder: Path) -> dict[str, Any]:
    """Reads what a checkpoint says of itself, without its tensors.

    Raises:
        CheckpointError: it is missing, damaged, or of a newer format.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise CheckpointError(
            f"Expected a checkpoint folder with {CONFIG}, got {folder} without one. "
            f"Make one with `benchnav-train all --out {folder}`."
        )
    try:
        text = path.read_text()
        config = json.loads(text)
        kind, version = (
            config["format"],
            tuple(int(part) for part in config["format_version"].split(".")),
        )
        if kind == FORMAT and _SEALED <= version <= FORMAT_VERSION:
            config = unseal(text)
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
    ) as error:
        raise _damaged(path, f"{type(error).__name__} {error}") from error
    if kind != FORMAT:
        raise CheckpointError(
            f"Expected format {FORMAT!r} in {path}, got {kind!r}. Name a benchnav "
            "checkpoint."
        )
    if version > FORMAT_VERSION or version < OLDEST_VERSION:
        remedy = "Train the model again with this version."
        if version > FORMAT_VERSION:
            remedy = "Read it with a newer benchnav: pip install --upgrade benchnav."
        raise CheckpointError(
            f"Expected format version {'.'.join(map(str, FORMAT_VERSION))} in {path}, "
            "got "
            f"{config['format_version']}. {remedy}"
        )
    return config


def read_ground(folder: Path, config: Mapping[str, Any]) -> GroundStatistics | None:
    """Reads the statistics of the ground that a checkpoint brings.

    Args:
        folder: of the checkpoint.
        config: what `read_config` gave of it. One that was written before there were
            such statistics does not name them; they may have been put beside its
            tensors since.

    Raises:
        CheckpointError: they are missing or damaged.
    """
    path, sha256 = folder / GROUND, config.get("ground", {}).get("sha256")
    if not sha256 and not path.is_file():
        return None
    try:
        content = path.read_bytes()
        if sha256 and hashlib.sha256(content).hexdigest() != sha256:
            raise _damaged(path, "its SHA-256 is not the one in config.json")
        return GroundStatistics.from_json(content.decode())
    except (OSError, UnicodeDecodeError, ConfigError) as error:
        raise _damaged(path, str(error)) from error


def _write(folder: Path, checkpoint: Checkpoint, name: str) -> None:
    parts = {}
    for part_name, part in checkpoint.parts.items():
        content = safetensors.torch.save(_to_store(part.tensors, part.half_precision))
        with replacing(folder / f"{part_name}.safetensors") as partial:
            partial.write_bytes(content)
        kept = {
            key: value
            for key, value in vars(part).items()
            if key not in _APART and value is not None
        }
        digest = hashlib.sha256(content).hexdigest()
        parts[part_name] = {
            **kept,
            "data": {"id": part.data_id, "digest": part.data_digest},
            "sha256": digest,
        }
    optional: dict[str, Any] = {}
    if checkpoint.pool_temperature != 1:
        optional["pool_temperature"] = checkpoint.pool_temperature
    if checkpoint.code:
        optional["code"] = checkpoint.code
    if checkpoint.conformal:
        optional["conformal"] = dict(checkpoint.conformal)
    if checkpoint.ground:
        text = checkpoint.ground.to_json()
        write_text(folder / GROUND, text)
        optional["ground"] = {"sha256": hashlib.sha256(text.encode()).hexdigest()}
    config = {
        "format": FORMAT,
        "format_version": ".".join(map(str, FORMAT_VERSION)),
        "model": checkpoint.model,
        "class_count": len(checkpoint.class_names),
        "class_names": list(checkpoint.class_names),
        **optional,
        "parts": parts,
    }
    if parts:
        write_text(
            folder / CARD,
            card_of(
                name,
                checkpoint.model,
                checkpoint.parts,
                checkpoint.class_names,
                checkpoint.code,
                checkpoint.conformal.get("maps", 0),
                checkpoint.pool_temperature,
            ),
        )
    write_text(folder / CONFIG, seal(config) + "\n")


def _to_store(tensors: Mapping[str, Tensor], half: bool) -> dict[str, Tensor]:
    stored = {
        name: value.detach().cpu().contiguous().clone()
        for name, value in tensors.items()
    }
    for name, value in stored.items():
        # Kernels alone: running variances and biases are few, and may leave float16's
        # range.
        if half and value.is_floating_point() and value.ndim >= 2:
            stored[name] = value.half()
    return stored


def _read_part(path: Path, data: Mapping[str, str], sha256: str, **entry: Any) -> Part:
    try:
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != sha256:
            raise _damaged(path, "its SHA-256 is not the one in config.json")
        tensors = _as_read(safetensors.torch.load(content))
    except (OSError, safetensors.SafetensorError) as error:
        raise _damaged(path, str(error)) from error
    return Part(
        **entry, tensors=tensors, data_id=data["id"], data_digest=data["digest"]
    )


def _as_read(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {
        name: value.float() if value.dtype == torch.float16 else value
        for name, value in tensors.items()
    }


def _damaged(path: Path, why: str) -> CheckpointError:
    return CheckpointError(
        f"{path} is damaged: {why}. Copy the checkpoint again whole, or train it again."
    )
