"""What a user's own part touches while it runs: files, installed packages, and
variables of the environment.

The source of a part, and what it imports by name, are known before a run. What it
opens, or imports under a name that is put together at run time, is seen only as it
happens. From the first part of a user's on, this process watches:

- files that are opened for reading through Python, and modules that are imported, by an
  audit hook;
- files that benchnav's own functions read for a part and Python does not see (HDF5,
  Parquet, rasters), by `note_file`;
- variables that code of the part itself reads from `os.environ`.

An event counts for every source file on the stack that a function of benchnav called.
Not seen: files that other libraries open outside Python (`h5py`, `pyarrow`, GDAL,
SQLite), what other processes and threads of a part do, listings of folders, clocks,
networks, and copies of the whole of `os.environ`. Left out: the standard library,
installed packages, and temporary and cache folders, unless the file lies below the
folder of the source that opens it.
"""

import hashlib
import importlib
import inspect
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache, lru_cache, wraps
from importlib.metadata import (
    PackageNotFoundError,
    packages_distributions,
    requires,
    version,
)
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

from packaging.requirements import InvalidRequirement, Requirement

from benchnav.core.errors import ConfigError
from benchnav.core.shipped_files import PACKAGE
from benchnav.core.sources import (
    digest_of_path,
    imported_names,
    imported_sources,
    installed_folders,
)

# what identifies the content, by "file PATH", "package NAME" or "variable NAME"
Touches = dict[str, str]

# which benchnav sets for its workers
THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
)
_SYSTEM = ("/proc/", "/sys/", "/dev/")

# By the source file that the event counts for.
# digests by absolute path, as files were when they were last read
_files: dict[str, dict[str, str]] = {}
_modules: dict[str, set[str]] = {}  # names of modules
_variables: dict[str, dict[str, str]] = {}  # digests of values by name
_written: dict[str, set[str]] = {}  # files that were opened for writing too: output
_digests: dict[tuple[str, int, int], str] = {}  # by path, time of change and size
_part_folders: set[str] = set()  # of parts that are installed packages
_state = threading.local()
_watching = False


def watch(part_folder: Path | None = None) -> None:
    """Begin to watch this process; it never ends.

    Args:
        part_folder: folder of an installed package whose code is a part; else its code
            counts as a library.
    """
    global _watching
    if part_folder is not None:
        _part_folders.add(f"{part_folder}{os.sep}")
        _is_own.cache_clear()
    if not _watching:
        _watching = True
        sys.addaudithook(_hook)
        importlib.import_module = _watched(importlib.import_module)
        os.environ.__class__ = _WatchedEnviron


def note_file(path: Path | str) -> None:
    """Note that a file is read, if a part asked for it; for readers that Python's audit
    hook does not see.
    """
    if _watching:
        _note_read(os.fspath(path))


def touches_of(targets: Iterable[Callable[..., Any]]) -> Touches:
    """Return what parts have touched in this process so far.

    Args:
        targets: the classes and functions of a user's own.

    Returns:
        Of files and variables the digest of what was read last, empty for what was not
        there; of packages the version. Packages are those that the parts import, and
        those that these require, as far as they are loaded.
    """
    sources = {
        name: content
        for target in targets
        for name, content in _sources(target).items()
    }
    touches: Touches = {}
    names: set[str] = set()
    for source, (package, content) in sources.items():
        names |= {*imported_names(content, package), *_modules.get(source, ())}
        # Sources that are imported by name are part of the key of a unit.
        for path in (
            set(_files.get(source, ())) - _written.get(source, set()) - set(sources)
        ):
            touches[f"file {_relative(path)}"] = _files[source][path]
        touches |= {
            f"variable {name}": digest
            for name, digest in _variables.get(source, {}).items()
        }
    for name in sorted(names):
        file = getattr(sys.modules.get(name), "__file__", None)
        if file and _is_own(file) and file not in sources:
            touches[f"file {_relative(file)}"] = digest_of_path(Path(file))
    return touches | {
        f"package {name}": number for name, number in _versions(names).items()
    }


def merge(others: Mapping[str, Mapping[str, Any]]) -> None:
    """Add what another process saw, as `snapshot` returns it."""
    for source, files in others["files"].items():
        _files.setdefault(source, {}).update(files)
    for source, variables in others["variables"].items():
        _variables.setdefault(source, {}).update(variables)
    for kind, known in (("modules", _modules), ("written", _written)):
        for source, names in others[kind].items():
            known.setdefault(source, set()).update(names)


def snapshot() -> dict[str, Any]:
    """Return all that this process saw, for `merge`."""
    return {
        "files": _files,
        "variables": _variables,
        "modules": _modules,
        "written": _written,
    }


def changes_since(touches: Mapping[str, str]) -> list[str]:
    """Return what of a record is not so any more, in words.

    Args:
        touches: from `touches_of`, of this process or of another on this machine.
    """
    return unlike(touches, {name: _now(name) for name in touches})


def unlike(one: Mapping[str, str], other: Mapping[str, str]) -> list[str]:
    """Return in what two records differ, of what both hold, in words; of packages with
    their versions.
    """
    return [
        f"{name} ({digest or 'none'} to {other[name] or 'none'})"
        if name.startswith("package ")
        else name
        for name, digest in one.items()
        if other.get(name, digest) != digest
    ]


def _now(name: str) -> str:
    kind, _, of = name.partition(" ")
    if kind == "file":
        return digest_of_path(Path(of))
    if kind == "variable":
        return _digest_of_value(of, os.environ.get(of))
    try:
        return version(of)
    except PackageNotFoundError:
        return ""


def _relative(path: str) -> str:
    """A path from the working folder, if it lies below; run folders can then be moved
    with it.
    """
    here = os.getcwd()
    return os.path.relpath(path, here) if path.startswith(f"{here}{os.sep}") else path


# --- what happens in this process ---


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    """Note what is opened and imported; whatever it does itself raises events too,
    which are left out.
    """
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
    sources = [
        source for source in _calling_sources() if not _is_left_out(name, source)
    ]
    if not sources or (os.path.exists(name) and not os.path.isfile(name)):
        return
    _state.is_noting = True
    try:
        stat = os.stat(name) if os.path.exists(name) else None
        version = (name, stat.st_mtime_ns, stat.st_size) if stat else (name, 0, 0)
        if version not in _digests:
            _digests[version] = digest_of_path(Path(name))
    except (
        OSError,
        ConfigError,
    ):  # it cannot be read, which the part learns from its own call
        _digests[version := (name, 0, 0)] = ""
    finally:
        _state.is_noting = False
    for source in sources:
        _files.setdefault(source, {})[name] = _digests[version]


def _watched(import_module: Callable[..., ModuleType]) -> Callable[..., ModuleType]:
    """Return `importlib.import_module`, which raises no audit event, as a function that
    notes the name.
    """

    @wraps(import_module)
    def watched(name: str, package: str | None = None) -> ModuleType:
        module = import_module(name, package)
        for source in _calling_sources():
            _modules.setdefault(source, set()).add(module.__name__)
        return module

    return watched


class _WatchedEnviron(type(os.environ)):  # type: ignore[misc]
    """`os.environ` that notes which variables parts read; copies of the whole of it are
    not noted.
    """

    def __getitem__(self, key: str) -> str:
        """Return the value of a variable."""
        value: str | None = None
        try:
            value = super().__getitem__(key)
            return value
        finally:
            frame = _caller()
            is_asked = (
                frame is not None
                and key not in THREADS
                and _instruction(frame) != _copying()
            )
            if is_asked and _is_own(frame.f_code.co_filename):  # type: ignore[union-attr]
                for source in _calling_sources():
                    _variables.setdefault(source, {})[key] = _digest_of_value(
                        key, value
                    )

    def __iter__(self) -> Iterator[str]:
        """Iterate over names; values that the same instruction reads are those of a
        copy.
        """
        frame = _caller()
        _state.copying = None if frame is None else _instruction(frame)
        return super().__iter__()


def _caller() -> FrameType | None:
    """Return the frame that asked `os.environ`, behind those of the standard library."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None and _is_standard(frame.f_code.co_filename):
        frame = frame.f_back
    return frame


def _instruction(frame: FrameType) -> tuple[int, int]:
    return id(frame), frame.f_lasti


def _copying() -> tuple[int, int] | None:
    return getattr(_state, "copying", None)


def _calling_sources() -> set[str]:
    """Return the own source files on the stack that a function of benchnav called,
    directly or not.
    """
    sources: set[str] = set()
    since_ours: set[str] = set()
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(_OURS):
            sources |= since_ours
        elif _is_own(name):
            since_ours.add(name)
        frame = frame.f_back
    return sources


# --- whose a file is ---

_OURS = f"{PACKAGE}{os.sep}"


@cache
def _is_own(name: str) -> bool:
    """Return whether code is a user's: not of benchnav, not installed, and not made by
    a library at run time.
    """
    if name.startswith(tuple(_part_folders)):
        return True
    is_made = name.startswith("<") and not name.startswith(("<ipython", "<stdin"))
    return not (is_made or name.startswith(_OURS) or _is_installed(name))


@cache
def _is_installed(name: str) -> bool:
    path = Path(name)
    return any(path.is_relative_to(folder) for folder in installed_folders())


@cache
def _is_standard(name: str) -> bool:
    """Return whether code is of the standard library."""
    return name.startswith("<frozen") or Path(name).parent in (
        _STANDARD,
        _STANDARD / "collections",
    )


_STANDARD = Path(os.__file__).parent


def _is_left_out(name: str, source: str) -> bool:
    """Return whether a file is none of a part's data: of the system, installed, or
    temporary.
    """
    if (
        name.startswith((*_SYSTEM, _OURS))
        or "__pycache__" in name
        or _is_installed(name)
    ):
        return True
    passing = _passing_folders()
    near = os.path.dirname(source)
    if near not in passing and name.startswith(f"{near}{os.sep}"):
        return False
    return name.startswith(tuple(f"{folder}{os.sep}" for folder in passing))


def _passing_folders() -> tuple[str, ...]:
    """Return the temporary and cache folders."""
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return (
        tempfile.gettempdir(),
        os.path.realpath(tempfile.gettempdir()),
        os.path.abspath(caches),
    )


def _digest_of_value(name: str, value: str | None) -> str:
    return (
        ""
        if value is None
        else hashlib.sha256(f"{name}={value}".encode()).hexdigest()[:16]
    )


def _sources(target: Callable[..., Any]) -> dict[str, tuple[str, bytes]]:
    """Return package and content of the own source files of a part and of what these
    import, by name.
    """
    sources: dict[str, tuple[str, bytes]] = {}
    for kind in (
        inspect.getmro(target) if inspect.isclass(target) else (inspect.unwrap(target),)
    ):
        codes = [
            getattr(value, "__code__", None) for value in (kind, *vars(kind).values())
        ]
        module = sys.modules.get(kind.__module__)
        names = {code.co_filename for code in codes if code} | {
            getattr(module, "__file__", None) or ""
        }
        package = getattr(module, "__package__", "") or ""
        sources |= {
            name: (package, _content(name)) for name in names if name and _is_own(name)
        }
    for name, (package, content) in list(sources.items()):
        for imported in imported_sources(Path(name).parent, package, content):
            module = sys.modules.get(imported)
            file = getattr(module, "__file__", None)
            if file and _is_own(file):
                sources[file] = (
                    getattr(module, "__package__", "") or "",
                    _content(file),
                )
    return sources


def _content(name: str) -> bytes:
    """Return the source, empty if there is none, as for cells of a notebook."""
    path = Path(name)
    return path.read_bytes() if path.is_file() else b""


def _versions(modules: Iterable[str]) -> dict[str, str]:
    """Return the versions of the distributions of modules and of what these require, as
    far as it is loaded.
    """
    places = _places()
    distributions = _distributions(places)
    loaded = {name.partition(".")[0] for name in list(sys.modules)}
    there = {dist for package in loaded for dist in distributions.get(package, ())}
    tops = {name.partition(".")[0] for name in modules} & loaded
    todo = [
        dist for top in tops - {PACKAGE.name} for dist in distributions.get(top, ())
    ]
    versions: dict[str, str] = {}
    by_name = {_normal(dist): dist for dist in there}
    while todo:
        dist = todo.pop()
        if dist in versions or _normal(dist) == PACKAGE.name:
            continue
        versions[dist], required = _metadata(places, dist)
        todo += [by_name[name] for name in required if name in by_name]
    return versions


def _places() -> tuple[tuple[str, int], ...]:
    """Return where modules are looked for, with the times at which the folders changed
    last, as installing does.
    """
    return tuple(
        (
            place,
            os.stat(place or ".").st_mtime_ns if os.path.exists(place or ".") else 0,
        )
        for place in sys.path
    )


@lru_cache(maxsize=1)
def _distributions(places: tuple[tuple[str, int], ...]) -> Mapping[str, list[str]]:
    """Return the installed distributions of each top-level module; to look takes a
    quarter of a second.
    """
    return packages_distributions()


@lru_cache(maxsize=1024)
def _metadata(
    places: tuple[tuple[str, int], ...], dist: str
) -> tuple[str, tuple[str, ...]]:
    """Return the version of a distribution, and the names that it requires here."""
    required = []
    for text in requires(dist) or ():
        with suppress(InvalidRequirement):
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                required.append(_normal(requirement.name))
    return version(dist), tuple(required)


def _normal(name: str) -> str:
    return name.lower().replace("_", "-").replace(".", "-")
