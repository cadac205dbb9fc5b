"""The folders that measures are written to: what is refused before any work is done."""

import tempfile
from collections.abc import Collection
from functools import partial
from pathlib import Path

FIGURES = "figures"
DPI = 300


def check_folder(out: Path, overwrite: bool, files: Collection[str], what: str) -> None:
    """Refuses a folder that cannot be written to, or that holds something else.

    Args:
        out: the folder.
        overwrite: whether what is there may be replaced.
        files: names of what such a folder holds, beside `FIGURES`.
        what: what that is, such as "an evaluation".
    """
    from benchnav.core.store import refuse_taken

    refuse_taken(out, overwrite, partial(_foreign, files={*files, FIGURES}, what=what))
    check_writable(out / next(iter(files)))


def check_writable(path: Path) -> None:
    """Refuses a file that cannot be written, by an OSError that names it."""
    nearest = next(parent for parent in path.absolute().parents if parent.exists())
    try:
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _foreign(folder: Path, files: set[str], what: str) -> str:
    """Says why what is at a place is none of these; empty where it is one. For `refuse_taken`."""
    own = folder.is_dir() and {item.name for item in folder.iterdir()} <= files
    return "" if own else f"is something else than {what}"
