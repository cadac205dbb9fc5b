"""Names of a model's parts, and a check for interrupted training."""

import os
from collections.abc import Collection
from pathlib import Path

from benchnav.core import registry
from benchnav.core.errors import CheckpointError

CLASSIFIER = "classifier"
GP = "gp"


def member_name(index: int, stem: str) -> str:
    """Return the part name of the member with an index from 0; the first is `stem`."""
    return f"{stem}-{index + 1}" if index else stem


def is_member(name: str, stem: str) -> bool:
    """Return whether a part name belongs to a member with this stem."""
    number = name.removeprefix(f"{stem}-")
    return name == stem or (number != name and number.isdigit())


def training_command(part: str) -> str:
    """Return the subcommand of `benchnav-train` that trains a part."""
    stem = part.partition("-")[0]
    if stem in (CLASSIFIER, GP):
        return stem
    if stem in registry.names("model"):
        return f"fit {stem}"
    return f"fit path/to/file.py:{stem}"


def training_folder(folder: str | Path) -> Path:
    """Return the folder of a training's logs and state, next to its checkpoint."""
    return Path(f"{os.path.normpath(folder)}.training")


def check_finished(folder: str | Path, trained: Collection[str] = ()) -> None:
    """Check that the training of a model was not interrupted.

    Args:
        folder: folder of the model's checkpoint, which need not exist.
        trained: names of the parts in the checkpoint.

    Raises:
        CheckpointError: If the training folder has a part that the checkpoint lacks.
    """
    logs = training_folder(folder)
    unfinished = sorted(
        path.name
        for path in logs.glob("*")
        if path.is_dir() and path.name not in trained
    )
    if unfinished:
        command = "all" if GP in trained else training_command(unfinished[0])
        raise CheckpointError(
            f"Expected a trained model in {folder}, got one whose training was "
            f"interrupted: {logs / unfinished[0]} is not finished. Run the training "
            f"command again with --resume, such as `benchnav-train {command} --data "
            f"DATA --out {folder} --resume`."
        )
