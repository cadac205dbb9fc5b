"""Target of a training: the checkpoint that receives parts, and checks of its content.

The checks are made before training. If several processes train together, only the first
process checks and writes.
"""

from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from rich.filesize import decimal

from benchnav.core.errors import CheckpointError, DatasetError
from benchnav.core.ground import GroundStatistics
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.ground import fit_ground
from benchnav.models.checkpoint import (
    CONFIG,
    FUSED,
    Checkpoint,
    Part,
    load_checkpoint,
    open_for_writing,
    save_checkpoint,
)
from benchnav.models.config import TrainingConfig
from benchnav.models.parts import is_member
from benchnav.models.training.fit import (
    FitOptions,
    differing,
    forget,
    interrupted,
    is_first_process,
)


@dataclass
class Target:
    """A checkpoint that receives trained parts; each is saved when it is trained.

    Args:
        folder: folder of the checkpoint.
        checkpoint: current content of the checkpoint.
        digest: digest of the training data.
        options: training options.
        maps: dataset of the training; None for slip logs.
        changed: whether a part or calibration was saved.
    """

    folder: Path
    checkpoint: Checkpoint
    digest: str
    options: FitOptions
    maps: TerrainDataset | None = None
    changed: bool = False

    def has_part(self, name: str, config: Any, seed: int) -> bool:
        """Return whether an interrupted run has trained a part with the same settings.

        Args:
            name: name of the part.
            config: settings of the part; if it is a `TrainingConfig`, settings of the
                trainer are compared as well.
            seed: root seed of the part.

        Raises:
            CheckpointError: If the part was trained with other settings.
        """
        part = self.checkpoint.parts.get(name)
        if part is None:
            return False
        options = self.options
        # Parts of earlier versions lack newer settings and the settings of the trainer.
        expected = {**asdict(config), "seed": seed, "data": self.digest}
        stored = {
            key: part.config.get(key, default)
            for key, default in _defaults(type(config)).items()
        }
        stored |= {"seed": part.seed, "data": part.data_digest}
        if isinstance(config, TrainingConfig):
            for key in ("half_precision", "conformal"):
                expected[key] = getattr(options, key)
                stored[key] = getattr(part, key)
            if part.trainer is not None:
                expected |= {
                    f"trainer.{k}": v for k, v in options.trainer_settings.items()
                }
                stored |= {f"trainer.{k}": v for k, v in part.trainer.items()}
        differences = differing(expected, stored)
        if not differences:
            forget(options, name)  # training may have been killed before it did this
            return True
        remedy = "pass --overwrite instead of --resume"
        if interrupted(options, [name]):
            remedy = (
                "pass --overwrite with --resume to resume the training that replaces it"
            )
        raise CheckpointError(
            f"Expected the {name} in {self.folder} to have the settings, seed and maps "
            f"of this command, got a part with seed {part.seed}, trained on "
            f"{part.data_id}, with {differences}. Use the settings of that part, or "
            f"{remedy}."
        )

    def add(self, name: str, part: Part) -> None:
        """Save a trained part, and the terrain statistics of its training maps."""
        self.checkpoint = self.checkpoint.with_part(name, part)
        if self.maps and not self.changed and is_first_process():
            self.checkpoint = replace(self.checkpoint, ground=_ground_of(self.maps))
        self._save()
        forget(self.options, name)

    def set_pool_temperature(self, temperature: float) -> None:
        """Save the temperature of the average of an ensemble's members."""
        if temperature != self.checkpoint.pool_temperature:
            self.checkpoint = replace(
                self.checkpoint, pool_temperature=temperature, conformal={}
            )
            self._save()

    def set_conformal(self, table: Mapping[str, Any]) -> None:
        """Save the table of the conformal recalibration."""
        self.checkpoint = replace(self.checkpoint, conformal=table)
        self._save()

    def _save(self) -> None:
        if not is_first_process():
            return
        self.changed = True
        save_checkpoint(self.folder, self.checkpoint)
        size = sum(path.stat().st_size for path in self.folder.iterdir())
        parts = " and ".join(sorted(self.checkpoint.parts))
        print(f"wrote {self.folder} with {parts} ({decimal(size)})")


def fresh_checkpoint(
    dataset: TerrainDataset, model: str = FUSED, code: str = ""
) -> Checkpoint:
    """Return a checkpoint without parts.

    Args:
        dataset: dataset of the training, whose class names the checkpoint takes.
        model: family of the model.
        code: digest of the code of a custom class.
    """
    return Checkpoint(
        class_names=tuple(item.name for item in dataset.recipe.classes),
        model=model,
        code=code,
    )


def open_target(
    out: str | Path,
    fresh: Checkpoint,
    parts: list[str],
    digest: str,
    options: FitOptions,
    maps: TerrainDataset | None = None,
) -> Target:
    """Open the checkpoint that receives the trained parts.

    Args:
        out: folder of the checkpoint, which need not exist.
        fresh: a checkpoint without parts, with the model and classes of the training.
        parts: names of the parts to train.
        digest: digest of the training data.
        options: training options, including whether parts may be replaced.
        maps: dataset of the training; None for slip logs.

    Raises:
        CheckpointError: If parts would be lost, or the checkpoint does not match the
            training.
        ConfigError: If the folder exists and is not a checkpoint.
    """
    unfinished = interrupted(options, parts)
    # Only the first process checks; other processes ignore what it has already saved.
    is_other_process = not (options.resume or is_first_process())
    may_replace = options.overwrite or is_other_process
    if unfinished and not (options.resume or may_replace):
        raise CheckpointError(
            f"Expected no interrupted training in {options.folder}, got one of "
            f"{' and '.join(unfinished)}. Pass --resume to resume it, or --overwrite "
            "to restart it."
        )
    # An unwritable checkpoint is reported before the training instead of after it.
    with open_for_writing(out) as (folder, _):
        checkpoint = existing(folder, may_replace) or fresh
    if not may_replace:
        _check_family(folder, checkpoint, fresh)
    if (checkpoint.model, checkpoint.class_names) != (fresh.model, fresh.class_names):
        checkpoint = fresh
    checkpoint = replace(checkpoint, code=fresh.code)
    if may_replace:
        # Members of an ensemble are replaced together.
        remaining = {
            name: part
            for name, part in checkpoint.parts.items()
            if name not in parts and not any(is_member(name, stem) for stem in parts)
        }
        checkpoint = replace(checkpoint, parts=remaining)
    elif not options.resume and not checkpoint.parts.keys().isdisjoint(parts):
        # If only GPs are trained, there is no folder to resume from.
        resume = ""
        if options.folder:
            resume = ", or --resume to resume an interrupted training"
        trained = " and ".join(sorted(checkpoint.parts))
        raise CheckpointError(
            f"Expected `out` without a trained {' or '.join(parts)}, got {folder} "
            f"with {trained}. Choose another `out`, or pass --overwrite to replace it"
            f"{resume}."
        )
    return Target(folder, checkpoint, digest, options, maps)


def _check_family(folder: Path, checkpoint: Checkpoint, fresh: Checkpoint) -> None:
    """Check that a checkpoint has the model, code and classes of the training.

    Raises:
        CheckpointError: If the checkpoint has another model, code or class names.
    """
    if checkpoint.code != fresh.code and checkpoint.model == fresh.model:
        raise CheckpointError(
            f"Expected checkpoint {folder} to be trained with the current code of "
            f"{fresh.model}, got a checkpoint of other code. Pass --overwrite to "
            "replace the checkpoint."
        )
    if (checkpoint.model, checkpoint.class_names) != (fresh.model, fresh.class_names):
        expected, got = (
            f"a {item.model} model of the classes {', '.join(item.class_names)}"
            for item in (fresh, checkpoint)
        )
        raise CheckpointError(
            f"Expected checkpoint {folder} to be {expected}, got {got}. Choose another "
            "`out`, or pass --overwrite to replace it."
        )


def _ground_of(dataset: TerrainDataset) -> GroundStatistics | None:
    """Return the terrain statistics of a dataset; None if it has no observed λ."""
    try:
        return fit_ground(dataset)
    except DatasetError:
        return None


def existing(folder: Path, overwrite: bool) -> Checkpoint | None:
    """Return the checkpoint in a folder.

    Returns:
        The checkpoint; None if the folder has no checkpoint, or has a damaged checkpoint
        and `overwrite` is true.
    """
    try:
        return load_checkpoint(folder) if (folder / CONFIG).is_file() else None
    except CheckpointError:
        if overwrite:
            return None
        raise


def _defaults(kind: type) -> dict[str, Any]:
    """Return the default of each setting as plain data; None if it has no default."""
    defaults: dict[str, Any] = {}
    for item in fields(kind):
        value: Any = item.default
        if item.default_factory is not MISSING:
            value = item.default_factory()
        if value is MISSING:
            value = None
        elif is_dataclass(value) and not isinstance(value, type):
            value = asdict(value)
        defaults[item.name] = value
    return defaults
