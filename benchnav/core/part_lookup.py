"""Lookup of parts by the name of an entry point, by module or by file.

`find` returns the class or function of a part and where it comes from. Names come from
entry points of installed packages, which include the shipped parts, and from
`register`, which adds a name in this process only.
"""

import importlib
import importlib.util
import inspect
import itertools
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from benchnav.core import touched
from benchnav.core.errors import ConfigError, out_of_memory_error
from benchnav.core.renamed import PARTS
from benchnav.core.settings import hint, one_line, parameters
from benchnav.core.sources import (
    attribute,
    digest_of,
    digest_of_file_and_imports,
    digest_of_modules,
    digest_of_path,
    digest_of_target,
    distribution_of,
    load_file,
    renaming_note,
)

KINDS = (
    "planner",
    "model",
    "risk",
    "robot",
    "objective",
    "sensor",
    "ground",
    "belief",
    "metric",
    "layer",
    "figure",
)


@dataclass(frozen=True, kw_only=True)
class Found:
    """The class or function of a part, and where it comes from.

    Args:
        target: the class or function.
        origin: distribution, module or file that defines it, as text for users.
        source_digest: function that returns the digest of the source and all its
            imports; the digest is empty for shipped parts and parts without a source.
        shipped: whether benchnav contains the part.
        everywhere: whether other processes can find the part too.
        instance: object that was registered by `register_object`; None for other parts.
    """

    target: Any
    origin: str
    source_digest: Callable[[], str] = str
    shipped: bool = False
    everywhere: bool = True
    instance: Any = None

    @property
    def digest(self) -> str:
        """SHA-256 of the source, its imports, and the `files` that the part lists.

        Raises:
            ConfigError: If one of these `files` does not exist.
        """
        source = self.source_digest()
        files = list(_listed_files(self.target))
        return digest_of(map(str.encode, (source, *files))) if files else source


# Parts that were registered in this process, by kind and name.
_REGISTERED: dict[tuple[str, str], Found] = {}


# --- names ---


def register(kind: str, name: str, target: Any) -> None:
    """Register a part by name in this process only, for example in a notebook.

    Args:
        kind: one of `KINDS`.
        name: name of the part; it takes precedence over an entry point of that name.
        target: class or function of the part.
    """
    digest = partial(digest_of_target, target)
    _REGISTERED[check_kind(kind), name] = Found(
        target=target, origin="this process", source_digest=digest, everywhere=False
    )


def register_object(kind: str, name: str, instance: Any) -> str:
    """Register an existing object by name in this process only.

    Args:
        kind: one of `KINDS`.
        name: name of the object; if another part has this name, a number is appended.
        instance: the object.

    Returns:
        The name by which `registry.make` returns the object.
    """
    free_name = _free_name(kind, name, instance)
    is_class = inspect.isclass(instance)
    # `make` creates an instance of a registered class, and calls a registered risk
    # measure with a distribution. For any other object, register a function that
    # returns the object.
    if is_class or kind == "risk":
        register(kind, free_name, instance)
    else:
        register(kind, free_name, lambda: instance)
    has_source = is_class or inspect.isroutine(instance)
    source = instance if has_source else type(instance)
    digest = partial(digest_of_target, source)
    _REGISTERED[kind, free_name] = replace(
        _REGISTERED[kind, free_name], source_digest=digest, instance=instance
    )
    return free_name


def _free_name(kind: str, name: str, instance: Any) -> str:
    """Return the first of `name`, `name-2`, … that no other object has."""
    used_names = names(kind)
    candidate = name
    for number in itertools.count(2):
        if candidate not in used_names or _instance_of(kind, candidate) is instance:
            break
        candidate = f"{name}-{number}"
    return candidate


def is_object(kind: str, source: str) -> bool:
    """Return whether `register_object` registered an object by this name."""
    return _instance_of(kind, source) is not None


def _instance_of(kind: str, source: str) -> Any:
    part = _REGISTERED.get((kind, source))
    return None if part is None else part.instance


def names(kind: str) -> list[str]:
    """Return all names of a kind, registered names included, in alphabetical order."""
    installed = {point.name for point in entry_points_of(kind)}
    registered = {
        name for registered_kind, name in _REGISTERED if registered_kind == kind
    }
    return sorted(installed | registered)


def shipped_names(kind: str) -> list[str]:
    """Return the names of shipped parts in alphabetical order; imports no part."""
    return sorted(
        point.name
        for point in entry_points_of(kind)
        if point.value.startswith("benchnav.")
    )


def entry_points_of(kind: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a kind in all installed packages."""
    return _points_on(check_kind(kind), tuple(sys.path))


@cache
def _points_on(kind: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Return the entry points of a kind; `path` only distinguishes cached results."""
    return tuple(entry_points(group=f"benchnav.{kind}s"))


def check_kind(kind: str) -> str:
    """Return the kind unchanged if it is valid.

    Raises:
        ConfigError: If `kind` is not one of `KINDS`.
    """
    if kind not in KINDS:
        raise ConfigError(
            f"Expected a kind of part among {', '.join(KINDS)}, got "
            f"{kind!r}.{hint(kind, KINDS)}"
        )
    return kind


# --- lookup ---


def find(kind: str, source: str) -> Found:
    """Find a part by name, module or file.

    Args:
        kind: one of `KINDS`.
        source: a name, `package.module:Name` or `path/to/file.py:Name`.

    Raises:
        ConfigError: If there is no such part, or it cannot be imported.
    """
    if (check_kind(kind), source) in _REGISTERED:
        touched.watch()
        return _REGISTERED[kind, source]
    points = [point for point in entry_points_of(kind) if point.name == source]
    if len(points) > 1:
        values = ", ".join(point.value for point in points)
        raise ConfigError(
            f"Expected one {kind} named {source!r}, got several: {values}. Write one "
            "of these instead of the name."
        )
    if points:
        location, colon, name = points[0].value.partition(":")
    else:
        location, colon, name = source.rpartition(":")
    if location.endswith(".py"):
        return _find_in_file(kind, Path(location), name)
    if colon and location:
        name_without_extras = name.partition("[")[0].strip()
        return _find_in_module(kind, location, name_without_extras)
    raise _unknown(kind, source, _remedy(kind, source))


def _remedy(kind: str, source: str) -> str:
    """Return a sentence with a remedy for a source that is not found, or ''."""
    if source.endswith(".py"):
        return f" Name a class or function in the file: {source}:Name."
    if Path(f"{source}.py").is_file():
        return f" Did you mean './{source}.py:Name'?"
    new_name = PARTS.get((kind, source))
    if new_name:
        return f" It is now {new_name!r}."
    return hint(source, names(kind))


def _unknown(kind: str, source: str, remedy: str, reason: str = "") -> ConfigError:
    options = f"{', '.join(names(kind))}, package.module:Name or path/to/file.py:Name"
    return ConfigError(
        f"Expected {with_article(kind)} among {options}, got "
        f"{source!r}{reason}.{remedy}"
    )


def with_article(kind: str) -> str:
    """Return a kind with its article, for messages."""
    return f"an {kind}" if kind == "objective" else f"a {kind}"


def _find_in_module(kind: str, module_name: str, name: str) -> Found:
    package = module_name.partition(".")[0]
    if package != "benchnav":
        touched.watch(_installed_folder(package))
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:
        raise _import_error(kind, module_name, name, error) from error
    target = attribute(module, module_name, name)
    if package == "benchnav":
        return Found(target=target, origin="benchnav", shipped=True)
    sources = []
    for source in {module_name, str(getattr(target, "__module__", module_name))}:
        if source.partition(".")[0] not in ("benchnav", "builtins"):
            sources.append(source)
    return Found(
        target=target,
        origin=distribution_of(package) or f"module {module_name}",
        source_digest=partial(digest_of_modules, sources),
    )


def _import_error(
    kind: str, module_name: str, name: str, error: BaseException
) -> Exception:
    """Return an error with a remedy for a module whose import failed."""
    is_missing = isinstance(
        error, ModuleNotFoundError
    ) and f"{module_name}.".startswith(f"{error.name}.")
    if not is_missing:
        return out_of_memory_error(error) or ConfigError(
            f"Expected a module that can be imported, got {module_name}: "
            f"{one_line(error)}{renaming_note(error)}"
        )
    remedy = renaming_note(error).removeprefix(".")
    if not remedy:
        file = Path(*module_name.split(".")).with_suffix(".py")
        remedy = hint(module_name, names(kind))
        if file.is_file():
            remedy = f" Did you mean './{file}:{name}'?"
    if not remedy:
        remedy = " Install its package, or name a file: path/to/file.py:Name."
    missing = getattr(error, "name", "")
    reason = f", and there is no module {missing!r}"
    return _unknown(kind, f"{module_name}:{name}", remedy, reason)


def _installed_folder(package: str) -> Path | None:
    """Return the folder of an installed package that contains a part, or None.

    The code in this folder then counts as code of the part; see `touched.watch`. The
    result is None for the standard library, to which a name may lead by mistake.
    """
    if package in sys.stdlib_module_names:
        return None
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    folders = list(spec.submodule_search_locations or ()) if spec else []
    return Path(folders[0]) if folders else None


def _find_in_file(kind: str, path: Path, name: str) -> Found:
    path = Path(os.path.expanduser(path))
    try:
        content = path.read_bytes()
    except OSError as error:
        siblings = [sibling.name for sibling in path.parent.glob("*.py")]
        raise ConfigError(
            f"Expected {with_article(kind)} in a file, got {str(path)!r}, which cannot "
            f"be read: {error.strerror}.{hint(path.name, siblings)}"
        ) from error
    touched.watch()
    module = load_file(path.resolve(), content)
    target = attribute(module, str(path), name)
    digest = partial(digest_of_file_and_imports, path.resolve(), content)
    return Found(target=target, origin=f"file {path}", source_digest=digest)


def _listed_files(target: Any) -> Iterator[str]:
    """Yield the name and then the digest of each of the `files` that a part lists."""
    files = getattr(target, "files", ())
    is_list = isinstance(files, list | tuple)
    if not files or not is_list or "files" in parameters(target):
        return
    module = sys.modules.get(str(getattr(target, "__module__", "")))
    folder = Path(getattr(module, "__file__", None) or "").parent
    for name in map(str, files):
        digest = digest_of_path(folder / name)
        if not digest:
            raise ConfigError(
                f"Expected `files` of {target.__qualname__} to exist in {folder}, got "
                f"{name!r}, which does not exist there."
            )
        yield name
        yield digest
