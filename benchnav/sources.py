"""Where a user's code comes from: loading it by file, taking a part of it, and digests of its sources."""

import hashlib
import importlib
import inspect
import sys
import traceback
from collections.abc import Callable, Iterable
from functools import cache, partial
from importlib.metadata import packages_distributions, version
from pathlib import Path
from types import ModuleType
from typing import Any

from benchnav.errors import BenchnavError, ConfigError
from benchnav.options import hint, one_line


def attribute(module: ModuleType, place: str, name: str) -> Any:
    """Gives a class or function of a module.

    Args:
        module: where it is.
        place: what users call the module, for messages.
        name: its name there, with dots where it is within a class.

    Raises:
        ConfigError: there is none.
    """
    target: Any = module
    for part in name.split("."):
        target = getattr(target, part, None)
    if _is_part(target):
        return target
    known = {n: v for n, v in vars(module).items() if _is_part(v) and not n.startswith("_")}
    own = [n for n, v in known.items() if getattr(v, "__module__", "") == module.__name__]
    got = "" if target is None else f", which is an object of {type(target).__name__}"
    listed = f" ({', '.join(own)})" if own else ""
    raise ConfigError(
        f"Expected a class or function of {place}{listed}, got {name!r}{got}.{hint(name, known)}"
    )


def _is_part(target: Any) -> bool:
    """Tells a class, function or wrapped function from an object that can be called, such as a robot."""
    return callable(target) and (
        inspect.isclass(target)
        or inspect.isroutine(target)
        or isinstance(target, partial)
        or hasattr(target, "__wrapped__")
    )


@cache
def load_file(path: Path, content: bytes) -> ModuleType:
    """Imports a file once for each of its contents, and writes nothing beside it.

    Args:
        path: the file, absolute.
        content: what it holds.

    Raises:
        ConfigError: it cannot be imported.
    """
    where = hashlib.sha256(str(path).encode() + b"\0" + content).hexdigest()[:16]
    module = ModuleType(f"benchnav_file_{path.stem}_{where}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses and compiled functions look their module up
    try:
        exec(compile(content, str(path), "exec"), vars(module))
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        if isinstance(error, BenchnavError):
            raise
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(path)]
        at = f" (line {lines[-1]})" if lines else ""
        remedy = ""
        if isinstance(error, ModuleNotFoundError):
            remedy = ". A file stands alone: install what it imports, or write it into the file."
        raise ConfigError(f"{path} could not be imported: {one_line(error)}{at}{remedy}") from error
    return module


def digest_of(contents: Iterable[bytes]) -> str:
    """SHA-256 over contents, each by its own digest."""
    whole = hashlib.sha256()
    for content in contents:
        whole.update(hashlib.sha256(content).digest())
    return whole.hexdigest()


def digest_of_target(target: Callable[..., Any]) -> str:
    """Digest of the file that defines a target or, in a notebook, of its own source; else empty."""
    try:
        file = Path(inspect.getfile(target))
        return digest_of([file.read_bytes() if file.is_file() else inspect.getsource(target).encode()])
    except (TypeError, OSError):
        return ""


@cache
def digest_of_package(package: str) -> str:
    """Digest of a package's sources with their names, or of a module's file."""
    module = importlib.import_module(package)
    folders = [Path(folder) for folder in getattr(module, "__path__", [])]
    files = [(path.relative_to(folder), path) for folder in folders for path in sorted(folder.rglob("*.py"))]
    if not files and getattr(module, "__file__", None):
        files = [(Path(package), Path(str(module.__file__)))]
    return digest_of(part for name, path in files for part in (name.as_posix().encode(), path.read_bytes()))


@cache
def distribution_of(package: str) -> str:
    """Name and version of the distribution that a package was installed with; empty where there is none."""
    distribution = next(iter(packages_distributions().get(package, [])), "")
    return f"{distribution} {version(distribution)}" if distribution else ""
