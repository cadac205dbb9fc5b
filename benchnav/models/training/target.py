"""The checkpoint that a training goes into: what may be written there, and what is
there already.

Every refusal comes before any work is done. Where processes train together, the first
alone refuses and writes.
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
    is_member,
    load_checkpoint,
    open_place,
    save_checkpoint,
)
from benchnav.models.config import TrainingConfig
from benchnav.models.training.fit import (
    FitOptions,
    differing,
    forget,
    interrupted,
    is_first_process,
)


@dataclass
class Target:
    """A checkpoint that parts are added to, one after the other, each saved as soon as
    it is trained.

    Args:
        folder: where it is saved.
        checkpoint: what it holds so far.
        digest: of the data that parts are trained on.
        options: how they are trained.
        maps: that parts are trained on; None where it is a robot's logs.
        changed: whether anything was saved.
    """

    folder: Path
    checkpoint: Checkpoint
    digest: str
    options: FitOptions
    maps: TerrainDataset | None = None
    changed: bool = False

    def holds(self, name: str, config: Any, seed: int) -> bool:
        """Tells whether an interrupted run has left a part, trained in the same way.

        Args:
            name: of the part.
            config: settings of its training; such of a `TrainingConfig` under those of
                the trainer as well.
            seed: its root seed.

        Raises:
            CheckpointError: it was trained in another way.
        """
        part = self.checkpoint.parts.get(name)
        if part is None:
            return False
        # A part of an earlier version does not name settings that came later, nor those
        # of the trainer.
        options, defaults = self.options, _defaults(type(config))
        wanted = {**asdict(config), "seed": seed, "data": self.digest}
        there = {key: part.config.get(key, usual) for key, usual in defaults.items()}
        there |= {"seed": part.seed, "data": part.data_digest}
        if isinstance(config, TrainingConfig):
            for key in ("half_precision", "conformal"):
                wanted[key], there[key] = getattr(options, key), getattr(part, key)
            if part.trainer is not None:
                wanted |= {
                    f"trainer.{key}": value
                    for key, value in options.trainer_settings.items()
                }
                there |= {
                    f"trainer.{key}": value for key, value in part.trainer.items()
                }
        others = differing(wanted, there)
        if not others:
            forget(options, name)  # a kill may have come between saving and forgetting
            return True
        remedy = "pass --overwrite instead of --resume"
        if interrupted(options, [name]):
            remedy = (
                "pass --overwrite with --resume to go on with the training that "
                "replaces it"
            )
        raise CheckpointError(
            f"Expected the {name} in {self.folder} to be of these settings, seed and "
            "maps, got others: of seed "
            f"{part.seed} and {part.data_id}, {others}. Repeat its settings, or "
            f"{remedy}."
        )

    def add(self, name: str, part: Part) -> None:
        """Saves a trained part with the rest, and with the statistics of the ground
        that it was trained on.
        """
        self.checkpoint = self.checkpoint.with_part(name, part)
        if self.maps and not self.changed and is_first_process():
            self.checkpoint = replace(self.checkpoint, ground=_ground_of(self.maps))
        self._save()
        forget(self.options, name)

    def set_pool_temperature(self, temperature: float) -> None:
        """Saves the temperature of the pool of classifiers with the rest."""
        if temperature != self.checkpoint.pool_temperature:
            self.checkpoint = replace(
                self.checkpoint, pool_temperature=temperature, conformal={}
            )
            self._save()

    def set_conformal(self, table: Mapping[str, Any]) -> None:
        """Saves the table of a conformal recalibration with the rest."""
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
    """A checkpoint without parts, of a family of models, the classes of a dataset and
    the digest of a class's code.
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
    """Opens the checkpoint that training goes into.

    Args:
        out: folder where it is, or will be.
        fresh: without parts, of the family and classes that are to be trained.
        parts: names of the parts to train.
        digest: of the data that they are trained on.
        options: how to train, and whether what is there may be replaced.
        maps: that they are trained on; None where it is a robot's logs.

    Raises:
        CheckpointError: what is there would be lost or does not fit.
        ConfigError: the folder is something else.
    """
    left = interrupted(options, parts)
    # The first process alone refuses; those beside it begin without what it may have
    # saved meanwhile.
    may_replace = options.overwrite or not (options.resume or is_first_process())
    if left and not (options.resume or may_replace):
        raise CheckpointError(
            f"Expected no interrupted training in {options.folder}, got one of "
            f"{' and '.join(left)}. "
            "Pass --resume to go on with it, or --overwrite to start again."
        )
    # Whether a checkpoint can be written there shows now rather than after the
    # training.
    with open_place(out) as (folder, _):
        checkpoint = existing(folder, may_replace) or fresh
    if (
        checkpoint.code != fresh.code
        and checkpoint.model == fresh.model
        and not may_replace
    ):
        raise CheckpointError(
            f"Expected checkpoint {folder} to be of the present code of "
            f"{fresh.model}, got one of other code. "
            "Pass --overwrite to replace it."
        )
    if (checkpoint.model, checkpoint.class_names) != (fresh.model, fresh.class_names):
        if not may_replace:
            wanted, got = (
                f"a {item.model} model of the classes {', '.join(item.class_names)}"
                for item in (fresh, checkpoint)
            )
            raise CheckpointError(
                f"Expected checkpoint {folder} to be {wanted}, got {got}. "
                "Choose another `out`, or pass --overwrite to replace it."
            )
        checkpoint = fresh
    checkpoint = replace(checkpoint, code=fresh.code)
    if may_replace:
        # Members of an ensemble stand or fall together.
        kept = {
            name: part
            for name, part in checkpoint.parts.items()
            if name not in parts and not any(is_member(name, stem) for stem in parts)
        }
        checkpoint = replace(checkpoint, parts=kept)
    elif not options.resume and not checkpoint.parts.keys().isdisjoint(parts):
        # The processes alone are trained in a moment, and so not gone on with.
        resume = (
            ", or --resume to go on with an interrupted training"
            if options.folder
            else ""
        )
        raise CheckpointError(
            f"Expected `out` without a trained {' or '.join(parts)}, got {folder} "
            "with "
            f"{' and '.join(sorted(checkpoint.parts))}. Choose another `out`, or pass "
            "--overwrite to replace it"
            f"{resume}."
        )
    return Target(folder, checkpoint, digest, options, maps)


def _ground_of(dataset: TerrainDataset) -> GroundStatistics | None:
    """Statistics of a dataset's ground; None where no λ was observed, so that classes
    alone can be learned.
    """
    try:
        return fit_ground(dataset)
    except DatasetError:
        return None


def existing(folder: Path, overwrite: bool) -> Checkpoint | None:
    """The checkpoint in a folder; None where there is none, or a damaged one that may
    be replaced.
    """
    try:
        return load_checkpoint(folder) if (folder / CONFIG).is_file() else None
    except CheckpointError:
        if overwrite:
            return None
        raise


def _defaults(kind: type) -> dict[str, Any]:
    """Usual values of all settings, plain data; None of those that have none."""
    usual = {
        item.name: item.default_factory()
        if item.default_factory is not MISSING
        else item.default
        for item in fields(kind)
    }
    return {
        name: asdict(value)
        if is_dataclass(value) and not isinstance(value, type)
        else value
        for name, value in usual.items()
    } | {name: None for name, value in usual.items() if value is MISSING}
