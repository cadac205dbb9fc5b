"""The checkpoint that a training goes into: what may be written there, and what is there already.

Every refusal comes before any work is done. Where processes train together, the first alone refuses
and writes.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from rich.filesize import decimal

from benchnav.core.errors import CheckpointError
from benchnav.core.store import building, real_place, refuse_taken, restore
from benchnav.models.checkpoint import (
    CLASSIFIER,
    Checkpoint,
    Part,
    foreign,
    is_member,
    load_checkpoint,
    save_checkpoint,
)
from benchnav.models.training.fit import FitOptions, forget, interrupted, is_first_process


class Target:
    """A checkpoint that parts are added to, one after the other, each saved as soon as it is trained.

    Args:
        folder: where it is saved.
        checkpoint: what it holds so far.
        digest: of the data that parts are trained on.
        options: how they are trained.
    """

    def __init__(self, folder: Path, checkpoint: Checkpoint, digest: str, options: FitOptions) -> None:
        """Starts with what is there."""
        self.folder, self.checkpoint = folder, checkpoint
        self.digest, self.options, self.changed = digest, options, False

    def holds(
        self,
        name: str,
        config: Mapping[str, Any],
        seed: int,
        defaults: Mapping[str, Any] = MappingProxyType({}),
        half_precision: bool | None = None,
    ) -> bool:
        """Tells whether an interrupted run has left a part, trained in the same way.

        Args:
            name: of the part.
            config: settings of its training.
            seed: its root seed.
            defaults: what settings are that a part of an earlier version does not name.
            half_precision: of a network, whether its kernels are kept as float16; such a part was trained under the
                settings of the trainer as well.

        Raises:
            CheckpointError: it was trained in another way.
        """
        part = self.checkpoint.parts.get(name)
        if part is None:
            return False
        wanted, there = (
            json.loads(json.dumps(dict(settings))) for settings in (config, {**defaults, **part.config})
        )
        others = [key for key, value in wanted.items() if there.get(key) != value]
        if half_precision is not None:
            others += ["half_precision"] * (half_precision != part.half_precision)
            # A part of an earlier version does not say under which settings of the trainer it was trained.
            asked = self.options.trainer_settings
            known = asked if part.trainer is None else dict(part.trainer)
            others += [
                f"trainer.{key}" for key in sorted({*asked, *known}) if asked.get(key) != known.get(key)
            ]
        if not others and (part.seed, part.data_digest) == (seed, self.digest):
            self._forget(name)  # a kill may have come between saving and forgetting
            return True
        remedy = "pass --overwrite instead of --resume"
        if self.options.folder and interrupted(self.options.folder, [name]):
            remedy = "pass --overwrite with --resume to go on with the training that was to replace it"
        named = f", another {' and '.join(f'`{key}`' for key in others)}" if others else ""
        if not others and part.seed == seed:
            named = ", other maps or another class table, or maps as recorded by benchnav before 0.7"
        raise CheckpointError(
            f"Expected the {name} in {self.folder} to be of these settings, seed and maps, got others: of seed "
            f"{part.seed} and {part.data_id}{named}. Repeat its settings, or {remedy}."
        )

    def add(self, name: str, part: Part) -> None:
        """Saves a trained part with the rest."""
        self.checkpoint = self.checkpoint.with_part(name, part)
        if is_first_process():
            self._save()
            self._forget(name)

    def set_pool_temperature(self, temperature: float) -> None:
        """Saves the temperature of the pool of classifiers with the rest."""
        if temperature != self.checkpoint.pool_temperature and is_first_process():
            self.checkpoint = replace(self.checkpoint, pool_temperature=temperature)
            self._save()

    def _save(self) -> None:
        self.changed = True
        save_checkpoint(self.folder, self.checkpoint)
        size = sum(path.stat().st_size for path in self.folder.iterdir())
        parts = " and ".join(sorted(self.checkpoint.parts))
        print(f"wrote {self.folder} with {parts} ({decimal(size)})")

    def _forget(self, name: str) -> None:
        if self.options.folder and is_first_process():
            forget(self.options.folder, name)


def open_target(
    folder: Path, fresh: Checkpoint, parts: list[str], digest: str, options: FitOptions, overwrite: bool
) -> Target:
    """Opens the checkpoint that training goes into.

    Args:
        folder: where it is, or will be.
        fresh: without parts, of the family and classes that are to be trained.
        parts: names of the parts to train.
        digest: of the data that they are trained on.
        options: how to train.
        overwrite: whether what is there may be replaced.

    Raises:
        CheckpointError: what is there would be lost or does not fit.
        ConfigError: the folder is something else.
    """
    folder = real_place(Path(os.path.normpath(folder)))  # a/../b is b, whether or not there is an a
    left = interrupted(options.folder, parts) if options.folder else []
    if left and not (options.resume or overwrite) and is_first_process():
        raise CheckpointError(
            f"Expected no interrupted training in {options.folder}, got one of {' and '.join(left)}. "
            "Pass --resume to go on with it, or --overwrite to begin anew."
        )
    checkpoint = _what_is_there(folder, fresh, overwrite)
    trained = [name for name in checkpoint.parts if name in parts]
    if overwrite:
        # Members of an ensemble stand or fall together.
        dropped = {
            name for name in checkpoint.parts if name in parts or (is_member(name) and CLASSIFIER in parts)
        }
        kept = {name: part for name, part in checkpoint.parts.items() if name not in dropped}
        checkpoint = replace(checkpoint, parts=kept)
    elif trained and not options.resume and is_first_process():
        # The processes alone are trained in a moment, and so not gone on with.
        resume = ", or --resume to go on with what an interrupted training has left" if options.folder else ""
        raise CheckpointError(
            f"Expected `out` without a trained {' or '.join(parts)}, got {folder} with "
            f"{' and '.join(sorted(checkpoint.parts))}. Choose another `out`, or pass --overwrite to replace it"
            f"{resume}."
        )
    elif trained and not options.resume:
        checkpoint = fresh
    return Target(folder, checkpoint, digest, options)


def _what_is_there(folder: Path, fresh: Checkpoint, overwrite: bool) -> Checkpoint:
    restore(folder)
    refuse_taken(folder, True, foreign)
    if not folder.exists():
        # Whether a checkpoint can be written there shows now rather than after the training.
        with building(folder):
            return fresh
    try:
        there = load_checkpoint(folder)
    except CheckpointError:
        if overwrite:
            return fresh
        raise
    if (there.model, there.class_names) == (fresh.model, fresh.class_names):
        return there
    if overwrite:
        return fresh
    raise CheckpointError(
        f"Expected checkpoint {folder} to be {_describe(fresh)}, got {_describe(there)}. "
        "Choose another `out`, or pass --overwrite to replace it."
    )


def _describe(checkpoint: Checkpoint) -> str:
    return f"a {checkpoint.model} model of the classes {', '.join(checkpoint.class_names)}"
