"""The files of an evaluation and of a comparison, and what is checked before any work
is done.
"""

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
    what: str,
) -> "TerrainDataset":
    """Open the dataset that models are measured on, after a check of the other
    arguments.

    Args:
        data: its path or id.
        splits: which of its splits; None for every test split.
        seed: root seed.
        out: folder that is written to; if empty, none.
        overwrite: whether what is there may be replaced.
        files: names of what such a folder holds, in addition to `FIGURES`.
        what: what that is, such as "an evaluation".

    Raises:
        ConfigError: If `splits` is empty, or the folder holds something else.
    """
    from benchnav.core.errors import expect
    from benchnav.core.store import refuse_taken
    from benchnav.datagen.files.find import find_dataset
    from benchnav.datagen.files.reader import TerrainDataset
    from benchnav.models.config import check_seed

    check_seed(seed)
    if out:
        refuse_taken(
            Path(out), overwrite, partial(_foreign, files={*files, FIGURES}, what=what)
        )
        check_writable(Path(out, next(iter(files))))
    dataset = TerrainDataset(find_dataset(data))
    expect(splits != [], f"`splits` among {', '.join(dataset.splits)}, got none.")
    return dataset


def _foreign(folder: Path, files: set[str], what: str) -> str:
    """Return why what is at a path is none of these; empty if it is one. For
    `refuse_taken`.
    """
    own = folder.is_dir() and {item.name for item in folder.iterdir()} <= files
    return "" if own else f"is something else than {what}"


def check_writable(path: Path) -> None:
    """Reject a file that cannot be written, by an OSError that names it."""
    nearest = next(parent for parent in path.absolute().parents if parent.exists())
    try:
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
