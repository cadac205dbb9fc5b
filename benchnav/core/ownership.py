"""Whether a file is the user's, BenchNav's, installed, standard or temporary."""

import os
import tempfile
from functools import cache
from pathlib import Path

from benchnav.core.shipped_files import PACKAGE
from benchnav.core.sources import installed_folders

OURS = f"{PACKAGE}{os.sep}"  # path prefix of BenchNav's files

_LIBRARY = Path(os.__file__).parent
_STANDARD = (_LIBRARY, _LIBRARY / "collections")
_SYSTEM = ("/proc/", "/sys/", "/dev/")

# Folders of installed packages that contain a part.
_part_folders: set[str] = set()


def add_part_folder(folder: Path) -> None:
    """Count the code in the folder of an installed package as the user's."""
    _part_folders.add(f"{folder}{os.sep}")
    is_own.cache_clear()


@cache
def is_own(name: str) -> bool:
    """Return whether the code in a file is the user's.

    BenchNav's code, installed code, and code that a library generates at run time are
    not the user's.

    Args:
        name: file name of the code, as in `__code__.co_filename`.
    """
    if name.startswith(tuple(_part_folders)):
        return True
    is_generated = name.startswith("<") and not name.startswith(("<ipython", "<stdin"))
    return not (is_generated or name.startswith(OURS) or is_installed(name))


@cache
def is_installed(name: str) -> bool:
    """Return whether a file belongs to an installed package."""
    path = Path(name)
    return any(path.is_relative_to(folder) for folder in installed_folders())


@cache
def is_standard(name: str) -> bool:
    """Return whether the code in a file belongs to the standard library."""
    return name.startswith("<frozen") or Path(name).parent in _STANDARD


def is_excluded(name: str, source: str) -> bool:
    """Return whether a file that a part opens is not recorded.

    Not recorded are files of the system or of installed packages, and temporary files
    outside the folder of the part.

    Args:
        name: absolute path of the file.
        source: path of the source file that opens it.
    """
    if name.startswith((*_SYSTEM, OURS)) or "__pycache__" in name or is_installed(name):
        return True
    temporary = _temporary_folders()
    source_folder = os.path.dirname(source)
    if source_folder not in temporary and name.startswith(f"{source_folder}{os.sep}"):
        return False
    return name.startswith(tuple(f"{folder}{os.sep}" for folder in temporary))


def _temporary_folders() -> tuple[str, ...]:
    """Return the folders for temporary files and caches."""
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return (
        tempfile.gettempdir(),
        os.path.realpath(tempfile.gettempdir()),
        os.path.abspath(caches),
    )
