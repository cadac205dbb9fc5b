"""Checkpoints: a trained model as a folder of data; reading it runs no code.

`config.json` describes the model and the training of each part, and contains its own
SHA-256. A part, such as `classifier` or `gp`, has its tensors in `PART.safetensors`,
whose SHA-256 is in `config.json`. `ground.json` contains statistics of the training
maps, which the model itself does not use. A checkpoint is written to a temporary folder
next to its own and renamed, so that it is never incomplete.
"""

import hashlib
import json
import os
import platform
from collections.abc import Iterator, Mapping
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
from benchnav.core.errors import CheckpointError, ConfigError
from benchnav.core.ground import GroundStatistics
from benchnav.core.short_repr import short_repr
from benchnav.core.sources import digest_of_path
from benchnav.core.store import (
    building,
    check_output,
    check_replaceable,
    replace_folder,
    replacing,
    resolve_link,
    restore,
    seal,
    sole_writer,
    unseal,
    write_text,
)
from benchnav.models.card import CARD, card_of
from benchnav.models.parts import GP, member_name, training_command

FORMAT = "benchnav-checkpoint"
FORMAT_VERSION = (2, 3)
OLDEST_VERSION = (2, 0)
_FIRST_WITH_DIGEST = (2, 2)  # from this version on, config.json contains its own digest
CONFIG = "config.json"
GROUND = "ground.json"
FUSED = "fused"

# Fields of a part that config.json does not contain under their own names.
_STORED_ELSEWHERE = ("tensors", "data_id", "data_digest")
_PACKAGES = ("torch", "lightning", "gpytorch", "segmentation-models-pytorch", "numpy")


def _versions() -> dict[str, str]:
    packages = {name: version(name) for name in _PACKAGES}
    return {
        "benchnav": benchnav.__version__,
        "python": platform.python_version(),
        **packages,
    }


@dataclass(frozen=True, kw_only=True)
class Part:
    """One trained part of a model.

    Args:
        config: settings from which the part is rebuilt, as plain data.
        tensors: weights and tables by name.
        seed: root seed of the training.
        metrics: values of metrics after training, by name.
        data_id: name of the training data: a dataset, or a file of slip logs.
        data_digest: content digest of the training data.
        half_precision: whether kernels are stored as float16; they are read as float32.
        versions: versions of the packages that trained the part, by name.
        trainer: settings of the trainer that affect the result; None if the part has no
            trainer or was saved by an earlier version.
        conformal: whether every second map of `valid` was reserved for conformal
            recalibration.
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
        parts: trained parts by name; those of a fused model are `gp`, `classifier`,
            `classifier-2`, ….
        model: registered name of the family that rebuilds the model; for a custom class
            from a file or module, its class name.
        pool_temperature: temperature of the average of several members (see
            `models.nets.calibration`); 1 changes nothing.
        code: digest of the code of a custom class; empty for models of this package.
        conformal: a `models.conformal.ConformalTable` as plain data, which recalibrates
            the model; empty if the model is not recalibrated.
        ground: statistics of the maps of the latest training; None if no maps were used.
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
        """Return a part.

        Raises:
            CheckpointError: If the part has not been trained.
        """
        if name not in self.parts:
            raise CheckpointError(
                f"Expected a checkpoint with a part {name!r}, got one with "
                f"the parts {sorted(self.parts)}. Train {name!r} with `benchnav-train "
                f"{training_command(name)}` into the same folder."
            )
        return self.parts[name]

    def with_part(self, name: str, part: Part) -> "Checkpoint":
        """Return a copy with one part added or replaced.

        The conformal recalibration is removed. The pool temperature is reset to 1, unless
        the part is `gp`.
        """
        temperature = self.pool_temperature if name == GP else 1.0
        parts = {**self.parts, name: part}
        return replace(self, parts=parts, pool_temperature=temperature, conformal={})


def digests_of(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file that affects predictions, by file name.

    The card and the terrain statistics do not affect predictions.
    """
    suffixes = (".json", ".safetensors")
    paths = (path for path in folder.iterdir() if path.suffix in suffixes)
    return {
        path.name: digest_of_path(path) for path in sorted(paths) if path.name != GROUND
    }


def member_names(checkpoint: Checkpoint, stem: str) -> list[str]:
    """Return the names of existing members; without any, the first member's name."""
    names = [member_name(index, stem) for index in range(len(checkpoint.parts))]
    return [name for name in names if name in checkpoint.parts] or [stem]


def as_stored(tensors: Mapping[str, Tensor], half_precision: bool) -> dict[str, Tensor]:
    """Return tensors as they will be read back: kernels are rounded if stored as float16.

    Args:
        tensors: tensors of a part by name.
        half_precision: whether kernels are stored as float16.
    """
    return _as_read(_to_store(tensors, half_precision))


def save_checkpoint(folder: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint, and replace an existing one.

    Args:
        folder: folder of the checkpoint.
        checkpoint: content to write.

    Raises:
        OSError: If the checkpoint cannot be written.
        ConfigError: If the path exists and is not a checkpoint.
        BenchnavError: If another process is writing the checkpoint.
    """
    writer = sole_writer(Path(folder), str(folder))
    with writer, open_for_writing(folder) as (path, partial):
        _write(partial, checkpoint, path.name)
        replace_folder(partial, path, last=CONFIG)


@contextmanager
def open_for_writing(folder: str | Path) -> Iterator[tuple[Path, Path]]:
    """Provide the resolved path of a checkpoint, and an empty folder to write it to.

    Raises:
        OSError: If the folder cannot be written.
        ConfigError: If the path exists and is not a checkpoint.
    """
    check_output(str(folder))
    # a/../b is b even if a does not exist.
    path = resolve_link(Path(os.path.normpath(folder)))
    restore(path)
    check_replaceable(path, True, _why_no_checkpoint)
    with building(path) as partial:
        yield path, partial


def _why_no_checkpoint(path: Path) -> str:
    """Return why a path is not a checkpoint, for `check_replaceable`; empty if it is one."""
    is_checkpoint = (path / CONFIG).is_file()
    return "" if is_checkpoint else f"contains no {CONFIG}"


def load_checkpoint(folder: str | Path) -> Checkpoint:
    """Read a checkpoint, with tensors on the CPU; float16 tensors become float32.

    Raises:
        CheckpointError: If the checkpoint is missing or damaged, or this version cannot
            read its format.
    """
    folder = Path(folder)
    config = read_config(folder)
    try:
        parts = {
            name: _read_part(folder / f"{name}.safetensors", **entry)
            for name, entry in config["parts"].items()
        }
        names = config["class_names"]
        is_text = all(isinstance(name, str) for name in names)
        if not is_text or len(set(names)) != len(names):
            raise ValueError("class_names are not different texts")
        temperature = float(config.get("pool_temperature", 1.0))
        if not 0 < temperature < float("inf"):
            raise ValueError(f"pool_temperature is {temperature}")
        return Checkpoint(
            class_names=tuple(names),
            parts=parts,
            model=config["model"],
            pool_temperature=temperature,
            code=str(config.get("code", "")),
            conformal=dict(config.get("conformal", {})),
            ground=read_ground(folder, config),
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise _damage_error(
            folder / CONFIG, f"{type(error).__name__} {error}"
        ) from error


def read_config(folder: Path) -> dict[str, Any]:
    """Read the description of a checkpoint, without its tensors.

    Raises:
        CheckpointError: If the checkpoint is missing or damaged, or this version cannot
            read its format.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise CheckpointError(
            f"Expected a checkpoint folder with {CONFIG}, got {folder} without one. "
            f"Create one with `benchnav-train all --out {folder}`."
        )
    try:
        text = path.read_text()
        config = json.loads(text)
        kind = config["format"]
        version = tuple(int(part) for part in config["format_version"].split("."))
        if kind == FORMAT and _FIRST_WITH_DIGEST <= version <= FORMAT_VERSION:
            config = unseal(text)
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
    ) as error:
        raise _damage_error(path, f"{type(error).__name__} {error}") from error
    if kind != FORMAT:
        raise CheckpointError(
            f"Expected format {FORMAT!r} in {path}, got {kind!r}. Give the folder of a "
            "BenchNav checkpoint."
        )
    if version > FORMAT_VERSION or version < OLDEST_VERSION:
        remedy = "Train the model again with this version."
        if version > FORMAT_VERSION:
            remedy = "Read it with a newer benchnav: pip install --upgrade benchnav."
        raise CheckpointError(
            f"Expected format version {_version_text()} in {path}, got "
            f"{config['format_version']}. {remedy}"
        )
    return config


def _version_text() -> str:
    return ".".join(map(str, FORMAT_VERSION))


def read_ground(folder: Path, config: Mapping[str, Any]) -> GroundStatistics | None:
    """Read the terrain statistics of a checkpoint.

    Args:
        folder: folder of the checkpoint.
        config: result of `read_config`. In checkpoints of earlier versions it has no
            digest of the statistics; their file may have been added later.

    Raises:
        CheckpointError: If the statistics are missing or damaged.
    """
    path = folder / GROUND
    sha256 = config.get("ground", {}).get("sha256")
    if not sha256 and not path.is_file():
        return None
    try:
        content = path.read_bytes()
        if sha256 and hashlib.sha256(content).hexdigest() != sha256:
            raise _damage_error(path, "its SHA-256 is not the one in config.json")
        return GroundStatistics.from_json(content.decode())
    except (OSError, UnicodeDecodeError, ConfigError) as error:
        raise _damage_error(path, str(error)) from error


def _write(folder: Path, checkpoint: Checkpoint, name: str) -> None:
    """Write all files of a checkpoint to an empty folder.

    Args:
        folder: folder to write to.
        checkpoint: content to write.
        name: final name of the folder, for the card.
    """
    parts = {}
    for part_name, part in checkpoint.parts.items():
        content = safetensors.torch.save(_to_store(part.tensors, part.half_precision))
        with replacing(folder / f"{part_name}.safetensors") as partial:
            partial.write_bytes(content)
        entry = {
            key: value
            for key, value in vars(part).items()
            if key not in _STORED_ELSEWHERE and value is not None
        }
        entry["data"] = {"id": part.data_id, "digest": part.data_digest}
        entry["sha256"] = hashlib.sha256(content).hexdigest()
        parts[part_name] = entry
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
        "format_version": _version_text(),
        "model": checkpoint.model,
        "class_count": len(checkpoint.class_names),
        "class_names": list(checkpoint.class_names),
        **optional,
        "parts": parts,
    }
    if parts:
        card = card_of(
            name,
            checkpoint.model,
            checkpoint.parts,
            checkpoint.class_names,
            checkpoint.code,
            checkpoint.conformal.get("maps", 0),
            checkpoint.pool_temperature,
        )
        write_text(folder / CARD, card)
    write_text(folder / CONFIG, seal(config) + "\n")


def _to_store(tensors: Mapping[str, Tensor], half: bool) -> dict[str, Tensor]:
    stored = {
        name: value.detach().cpu().contiguous().clone()
        for name, value in tensors.items()
    }
    for name, value in stored.items():
        # Running variances and biases remain float32: they are few, and may exceed the
        # range of float16.
        if half and value.is_floating_point() and value.ndim >= 2:
            stored[name] = value.half()
    return stored


def _read_part(path: Path, data: Mapping[str, str], sha256: str, **entry: Any) -> Part:
    try:
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != sha256:
            raise _damage_error(path, "its SHA-256 is not the one in config.json")
        tensors = _as_read(safetensors.torch.load(content))
    except (OSError, safetensors.SafetensorError) as error:
        raise _damage_error(path, str(error)) from error
    return Part(
        **entry, tensors=tensors, data_id=data["id"], data_digest=data["digest"]
    )


def _as_read(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {
        name: value.float() if value.dtype == torch.float16 else value
        for name, value in tensors.items()
    }


def _damage_error(path: Path, reason: str) -> CheckpointError:
    return CheckpointError(
        f"{path} is damaged: {reason}. Copy the whole checkpoint again, or train it "
        "again."
    )
