"""Record of the files, packages and environment variables that custom parts use.

The source of a part, and the modules that it imports by name, are known before a run.
Files that the part opens, and modules whose names it composes at run time, are known
only during the run. From the first use of a custom part on, this process records:

- files that Python opens for reading, and imported modules, by an audit hook;
- files that BenchNav reads for a part with other libraries (HDF5, Parquet, rasters),
  which the hook does not detect, by `note_file`;
- environment variables that the part's own code reads from `os.environ`.

An event is recorded for each source file of the user on the call stack that BenchNav
called, even indirectly. Not recorded are files that the part opens with other libraries
(`h5py`, `pyarrow`, GDAL, SQLite), actions in other processes and threads, listings of
folders, clocks, networks, and copies of all of `os.environ`. `benchnav.core.ownership`
excludes the standard library, installed packages and temporary files.
"""

import hashlib
import importlib
import inspect
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import wraps
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

from benchnav.core.errors import ConfigError
from benchnav.core.loaded_versions import loaded_versions
from benchnav.core.ownership import (
    OURS,
    add_part_folder,
    is_excluded,
    is_own,
    is_standard,
)
from benchnav.core.sources import digest_of_path, imported_names, imported_sources

# Digest or version by entry. An entry is "file PATH", "package NAME" or "variable NAME".
Touches = dict[str, str]

# Environment variables that BenchNav sets for its workers.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

# Records of events, by path of the user's source file.
_files: dict[str, dict[str, str]] = {}  # digests at the last reading, by absolute path
_modules: dict[str, set[str]] = {}  # names of modules
_variables: dict[str, dict[str, str]] = {}  # digests of values, by name of the variable
_written: dict[str, set[str]] = {}  # files opened for writing, which count as output
# Digests of files by path, time of the last change in ns and size in bytes.
_digests: dict[tuple[str, int, int], str] = {}
_state = threading.local()
_watching = False


def watch(part_folder: Path | None = None) -> None:
    """Start to record in this process, until the process ends.

    Args:
        part_folder: folder of an installed package that contains a part. From now on,
            code in this folder counts as the user's, unlike code of other packages.
    """
    global _watching
    if part_folder is not None:
        add_part_folder(part_folder)
    if not _watching:
        _watching = True
        sys.addaudithook(_hook)
        importlib.import_module = _watched(importlib.import_module)
        os.environ.__class__ = _WatchedEnviron


def note_file(path: Path | str) -> None:
    """Record that a part reads a file, for readers that the audit hook does not detect."""
    if _watching:
        _note_read(os.fspath(path))


def touches_of(targets: Iterable[Callable[..., Any]]) -> Touches:
    """Return the record of parts in this process so far.

    Args:
        targets: classes and functions of custom parts.

    Returns:
        Digests of files and variables at the last reading, empty if the file or
        variable was missing; and versions of the packages that the parts import and of
        the loaded requirements of these packages.
    """
    sources: dict[str, tuple[str, bytes]] = {}
    for target in targets:
        sources |= _sources(target)
    touches: Touches = {}
    names: set[str] = set()
    for source, (package, content) in sources.items():
        names |= {*imported_names(content, package), *_modules.get(source, ())}
        # The key of a unit already depends on sources that are imported by name.
        read_paths = set(_files.get(source, ()))
        for path in read_paths - _written.get(source, set()) - set(sources):
            touches[f"file {_relative(path)}"] = _files[source][path]
        for name, digest in _variables.get(source, {}).items():
            touches[f"variable {name}"] = digest
    for name in sorted(names):
        file = getattr(sys.modules.get(name), "__file__", None)
        if file and is_own(file) and file not in sources:
            touches[f"file {_relative(file)}"] = digest_of_path(Path(file))
    for name, package_version in loaded_versions(names).items():
        touches[f"package {name}"] = package_version
    return touches


def merge(records: Mapping[str, Mapping[str, Any]]) -> None:
    """Add the records of another process, as returned by its `snapshot`."""
    for source, files in records["files"].items():
        _files.setdefault(source, {}).update(files)
    for source, variables in records["variables"].items():
        _variables.setdefault(source, {}).update(variables)
    for kind, names_per_source in (("modules", _modules), ("written", _written)):
        for source, names in records[kind].items():
            names_per_source.setdefault(source, set()).update(names)


def snapshot() -> dict[str, Any]:
    """Return all records of this process, for `merge`."""
    return {
        "files": _files,
        "variables": _variables,
        "modules": _modules,
        "written": _written,
    }


def changed_entries(touches: Mapping[str, str]) -> list[str]:
    """Return the entries of a record whose digest or version has changed, as texts.

    Args:
        touches: record from `touches_of`, in any process on this machine.
    """
    return differing_entries(
        touches, {entry: _present_digest(entry) for entry in touches}
    )


def differing_entries(a: Mapping[str, str], b: Mapping[str, str]) -> list[str]:
    """Return the entries that are in two records and differ, as texts.

    The text for a package includes both versions.
    """
    lines = []
    for name, digest in a.items():
        if b.get(name, digest) == digest:
            continue
        if name.startswith("package "):
            lines.append(f"{name} ({digest or 'none'} to {b[name] or 'none'})")
        else:
            lines.append(name)
    return lines


def _present_digest(entry: str) -> str:
    """Return the present digest or version of an entry; empty if it is missing."""
    kind, _, name = entry.partition(" ")
    if kind == "file":
        return digest_of_path(Path(name))
    if kind == "variable":
        return _digest_of_value(name, os.environ.get(name))
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _relative(path: str) -> str:
    """Return a path relative to the working folder if that folder contains it.

    Run folders can then be moved together with the files that they refer to.
    """
    cwd = os.getcwd()
    return os.path.relpath(path, cwd) if path.startswith(f"{cwd}{os.sep}") else path


# --- recording in this process ---


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    """Record opened files and imported modules, as an audit hook of Python."""
    if event not in ("open", "import") or getattr(_state, "is_noting", False):
        return
    if event == "import":
        for source in _calling_sources():
            _modules.setdefault(source, set()).add(arguments[0])
        return
    path, _, flags = arguments
    if isinstance(path, int) or path is None:
        return
    name = os.path.abspath(os.fsdecode(path))
    if isinstance(flags, int) and (
        flags & (os.O_WRONLY | os.O_RDWR) or flags & os.O_CREAT
    ):
        for source in _calling_sources():
            _written.setdefault(source, set()).add(name)
    else:
        _note_read(name)


def _note_read(path: str) -> None:
    name = os.path.abspath(path)
    sources = [source for source in _calling_sources() if not is_excluded(name, source)]
    if not sources or (os.path.exists(name) and not os.path.isfile(name)):
        return
    _state.is_noting = True
    try:
        stat = os.stat(name) if os.path.exists(name) else None
        state = (name, stat.st_mtime_ns, stat.st_size) if stat else (name, 0, 0)
        if state not in _digests:
            _digests[state] = digest_of_path(Path(name))
    except (OSError, ConfigError):
        # The part's own call raises the error of an unreadable file.
        state = (name, 0, 0)
        _digests[state] = ""
    finally:
        _state.is_noting = False
    for source in sources:
        _files.setdefault(source, {})[name] = _digests[state]


def _watched(import_module: Callable[..., ModuleType]) -> Callable[..., ModuleType]:
    """Return `import_module` with a record of the module, since it has no audit event."""

    @wraps(import_module)
    def import_and_record(name: str, package: str | None = None) -> ModuleType:
        module = import_module(name, package)
        for source in _calling_sources():
            _modules.setdefault(source, set()).add(module.__name__)
        return module

    return import_and_record


class _WatchedEnviron(type(os.environ)):  # type: ignore[misc]
    """`os.environ` that records variables that parts read, except in full copies."""

    def __getitem__(self, key: str) -> str:
        """Return the value of a variable."""
        value: str | None = None
        try:
            value = super().__getitem__(key)
            return value
        finally:
            frame = _caller()
            if (
                frame is not None
                and key not in THREADS
                and _instruction(frame) != _copying()
                and is_own(frame.f_code.co_filename)
            ):
                digest = _digest_of_value(key, value)
                for source in _calling_sources():
                    _variables.setdefault(source, {})[key] = digest

    def __iter__(self) -> Iterator[str]:
        """Iterate over names, and note the instruction, which may copy all variables."""
        frame = _caller()
        _state.copying = None if frame is None else _instruction(frame)
        return super().__iter__()


def _caller() -> FrameType | None:
    """Return the innermost frame outside the standard library that reads `os.environ`."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None and is_standard(frame.f_code.co_filename):
        frame = frame.f_back
    return frame


def _instruction(frame: FrameType) -> tuple[int, int]:
    return id(frame), frame.f_lasti


def _copying() -> tuple[int, int] | None:
    return getattr(_state, "copying", None)


def _calling_sources() -> set[str]:
    """Return the user's source files on the call stack that BenchNav called.

    Indirect calls count, too.
    """
    sources: set[str] = set()
    since_ours: set[str] = set()
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(OURS):
            sources |= since_ours
        elif is_own(name):
            since_ours.add(name)
        frame = frame.f_back
    return sources


# --- digests and sources ---


def _digest_of_value(name: str, value: str | None) -> str:
    """Return a digest of a variable's name and value, empty if it is not set."""
    if value is None:
        return ""
    return hashlib.sha256(f"{name}={value}".encode()).hexdigest()[:16]


def _sources(target: Callable[..., Any]) -> dict[str, tuple[str, bytes]]:
    """Return package and content of a part's source files and their imports, by path.

    Only the user's files are included.
    """
    sources: dict[str, tuple[str, bytes]] = {}
    kinds: tuple[Any, ...] = (inspect.unwrap(target),)
    if inspect.isclass(target):
        kinds = inspect.getmro(target)
    for kind in kinds:
        members = (kind, *vars(kind).values())
        codes = [getattr(member, "__code__", None) for member in members]
        module = sys.modules.get(kind.__module__)
        names = {code.co_filename for code in codes if code}
        names.add(getattr(module, "__file__", None) or "")
        package = getattr(module, "__package__", "") or ""
        for name in names:
            if name and is_own(name):
                sources[name] = (package, _content(name))
    for name, (package, content) in list(sources.items()):
        for imported in imported_sources(Path(name).parent, package, content):
            module = sys.modules.get(imported)
            file = getattr(module, "__file__", None)
            if file and is_own(file):
                module_package = getattr(module, "__package__", "") or ""
                sources[file] = (module_package, _content(file))
    return sources


def _content(name: str) -> bytes:
    """Return a file's content; empty without a file, as for cells of a notebook."""
    path = Path(name)
    return path.read_bytes() if path.is_file() else b""
