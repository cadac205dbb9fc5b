"""Files of evaluations and comparisons, and checks before measurement."""

import tempfile
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from benchnav.datagen.files.reader import TerrainDataset

FIGURES = "figures"
EVALUATION = "quality.json", "quality.csv", "quality.md"
COMPARISON = "compare.json", "compare.csv", "differences.csv", "compare.md"


def open_maps(
    data: str,
    splits: list[str] | None,
    seed: int,
    out: str,
    overwrite: bool,
    files: Collection[str],
    content: str,
) -> "TerrainDataset":
    """Check the arguments of a measurement and open its dataset.

    Args:
        data: path or id of the dataset.
        splits: names of splits; None for all test splits.
        seed: root seed of the measurement.
        out: output folder; if empty, nothing is written.
        overwrite: whether an existing measurement may be replaced.
        files: names of the files in an output folder, in addition to `FIGURES`.
        content: description of an output folder, such as "an evaluation".

    Raises:
        ConfigError: If `splits` is empty, or the folder contains other files.
    """
    from benchnav.core.errors import expect
    from benchnav.core.store import check_replaceable
    from benchnav.datagen.files.find import find_dataset
    from benchnav.datagen.files.reader import TerrainDataset
    from benchnav.models.config import check_seed

    check_seed(seed)
    if out:
        names = {*files, FIGURES}
        reason = partial(_why_not_replaceable, files=names, content=content)
        check_replaceable(Path(out), overwrite, reason)
        check_writable(Path(out, next(iter(files))))
    dataset = TerrainDataset(find_dataset(data))
    expect(splits != [], f"`splits` among {', '.join(dataset.splits)}, got none.")
    return dataset


def _why_not_replaceable(folder: Path, files: set[str], content: str) -> str:
    """Return why a path may not be replaced, for `check_replaceable`; empty if it may."""
    if folder.is_dir():
        names = {item.name for item in folder.iterdir()}
        if names <= files:
            return ""
    return f"is not {content}"


def check_writable(path: Path) -> None:
    """Check that a file can be written.

    Raises:
        OSError: If the file cannot be written; the error names it.
    """
    nearest = next(parent for parent in path.absolute().parents if parent.exists())
    try:
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
