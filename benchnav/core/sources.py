"""Where a user's code comes from: loading it by file, taking a part of it, and digests
of its sources.
"""

import ast
import hashlib
import importlib
import importlib.util
import inspect
import re
import site
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterable, Mapping
from functools import cache, partial
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import packages_distributions, version
from pathlib import Path
from types import ModuleType
from typing import Any

from benchnav.core.errors import BenchnavError, ConfigError, out_of_memory
from benchnav.core.renamed import IMPORTS
from benchnav.core.settings import hint, one_line
from benchnav.core.shipped_files import PACKAGE


def moved(error: BaseException) -> str:
    """Return a sentence with the new name of what an import did not find; empty if none
    is known.
    """
    if not isinstance(error, ImportError) or not error.name:
        return ""
    name = re.search(r"cannot import name '(\w+)'", str(error))
    old = f"{error.name}.{name[1]}" if name else error.name
    return f". {old} is now {IMPORTS[old]}." if old in IMPORTS else ""


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
    known = {
        n: v for n, v in vars(module).items() if _is_part(v) and not n.startswith("_")
    }
    own = [
        n for n, v in known.items() if getattr(v, "__module__", "") == module.__name__
    ]
    got = "" if target is None else f", which is an object of {type(target).__name__}"
    listed = f" ({', '.join(own)})" if own else ""
    raise ConfigError(
        f"Expected a class or function of {place}{listed}, got "
        f"{name!r}{got}.{hint(name, known)}"
    )


def _is_part(target: Any) -> bool:
    """Tells a class, function or wrapped function from an object that can be called,
    such as a robot.
    """
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
    sys.modules[module.__name__] = (
        module  # dataclasses and compiled functions look their module up
    )
    try:
        exec(compile(content, str(path), "exec"), vars(module))
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        if isinstance(error, BenchnavError):
            raise
        lines = [
            f.lineno
            for f in traceback.extract_tb(error.__traceback__)
            if f.filename == str(path)
        ]
        at = f" (line {lines[-1]})" if lines else ""
        remedy = moved(error)
        if not remedy and isinstance(error, ModuleNotFoundError):
            remedy = (
                ". A file stands alone: install what it imports, or write it "
                "into the file."
            )
        raise out_of_memory(error) or ConfigError(
            f"{path} could not be imported: {one_line(error)}{at}{remedy}"
        ) from error
    return module


def digest_of(contents: Iterable[bytes]) -> str:
    """SHA-256 over contents, each by its own digest."""
    whole = hashlib.sha256()
    for content in contents:
        whole.update(hashlib.sha256(content).digest())
    return whole.hexdigest()


def digest_of_path(path: Path) -> str:
    """Digest of a file, or of all files of a folder with their names; empty where there
    is neither.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        if path.is_dir():
            files = sorted(
                f
                for f in path.rglob("*")
                if f.is_file() and "__pycache__" not in f.parts
            )
            pairs = (
                (file.relative_to(path).as_posix(), digest_of_path(file))
                for file in files
            )
            return digest_of(item.encode() for pair in pairs for item in pair)
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ConfigError(
            f"Expected {path} to be readable, since a part reads it: {error.strerror}."
        ) from error


def digest_of_file_part(path: Path, content: bytes) -> str:
    """Digest of a file that stands alone and of the modules that it imports; see
    `imported_sources`.
    """
    return _digest_of_sources(
        {"": content} | imported_sources(path.parent, "", content)
    )


def digest_of_target(target: Callable[..., Any]) -> str:
    """Digest of the file that defines a target and its imports or, in a notebook, of
    its own source; else empty.
    """
    try:
        path = Path(inspect.getfile(target))
        content = (
            path.read_bytes() if path.is_file() else inspect.getsource(target).encode()
        )
    except (TypeError, OSError):
        return ""
    return digest_of_file_part(path, content)


def digest_of_modules(names: Iterable[str]) -> str:
    """Digest of modules: of all sources of the packages that they are in, and of what
    they import besides.
    """
    found: dict[str, bytes] = {}
    for name in sorted(names):
        package = importlib.import_module(name.partition(".")[0])
        folders = [Path(folder) for folder in getattr(package, "__path__", [])]
        files = [
            (file.relative_to(folder.parent), file)
            for folder in folders
            for file in folder.rglob("*.py")
        ]
        if not files and getattr(package, "__file__", None):
            files = [(Path(package.__name__), Path(str(package.__file__)))]
        found |= {place.as_posix(): _read_source(file) for place, file in files}
        module = sys.modules.get(name)
        file = Path(getattr(module, "__file__", None) or "")
        if file.is_file():
            within = getattr(module, "__package__", "") or ""
            found |= imported_sources(file.parent, within, file.read_bytes())
    return _digest_of_sources(found)


def package_modules(names: Iterable[str]) -> dict[str, str]:
    """Digests of modules of this package, and of all of it that they import, wherever
    in the code an import stands.

    A digest is of the syntax tree without docstrings: comments, layout and
    documentation do not change it. What a process has once read stays, as what it has
    imported does. Packages' own faces are left out: they hand names on.

    Args:
        names: of the modules to begin with.

    Returns:
        12 hexadecimal digits by name, in alphabetical order.
    """
    found: dict[str, str] = {}
    todo = list(names)
    while todo:
        name = todo.pop()
        module = None if name in found else _module(name)
        if module is not None:
            found[name], imported = module
            todo += imported
    return dict(sorted(found.items()))


@cache
def _module(name: str) -> tuple[str, tuple[str, ...]] | None:
    """The digest of a module of this package, and what it imports; None of any other
    name.
    """
    path = PACKAGE.parent.joinpath(*name.split(".")).with_suffix(".py")
    if name.partition(".")[0] != PACKAGE.name or not path.is_file():
        return None
    content = path.read_bytes()
    tree = ast.parse(content)
    for node in ast.walk(tree):
        if not isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        ):
            continue
        if ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:12], imported_names(
        content, ""
    )


def _digest_of_sources(found: Mapping[str, bytes]) -> str:
    return digest_of(
        item for name in sorted(found) for item in (name.encode(), found[name])
    )


def imported_sources(near: Path, package: str, content: bytes) -> dict[str, bytes]:
    """Sources of all that a module imports, and of what that imports, wherever in the
    code an import stands.

    The standard library, installed distributions and benchnav itself are left out:
    `run.json` has their versions and digests. Nothing is imported by this, and names
    that are put together at run time are not seen.

    Args:
        near: folder in which an imported file may lie besides `sys.path`.
        package: of the module, empty for none.
        content: its source.

    Returns:
        By the name of the module.
    """
    found: dict[str, bytes] = {}
    todo = [(package, content)]
    while todo:
        package, content = todo.pop()
        for name in imported_names(content, package):
            if name in found or name.partition(".")[0] in (
                *sys.stdlib_module_names,
                "benchnav",
            ):
                continue
            spec = _spec(name, near)
            if spec is None or not spec.has_location or not spec.origin:
                continue
            path = Path(spec.origin)
            if not path.is_file() or any(map(path.is_relative_to, installed_folders())):
                continue
            found[name] = _read_source(path)
            if path.suffix == ".py":
                todo.append((spec.parent or "", path.read_bytes()))
    return found


@cache
def imported_names(content: bytes, package: str) -> tuple[str, ...]:
    """Modules that a source may import, with the packages around them; of `from a
    import b` both a and a.b.
    """
    named = []
    try:
        tree = ast.parse(content)
    except (SyntaxError, ValueError):
        return ()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            named += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            outer = (
                package.split(".")[: len(package.split(".")) - node.level + 1]
                if node.level
                else []
            )
            base = ".".join([*outer, *([node.module] if node.module else [])])
            named += [base, *(f"{base}.{alias.name}" for alias in node.names)]
        elif (
            isinstance(node, ast.Call)
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if called in ("import_module", "__import__") and isinstance(
                node.args[0].value, str
            ):
                named.append(node.args[0].value)
    parts = [name.split(".") for name in named if name and not name.startswith(".")]
    return tuple(
        dict.fromkeys(
            ".".join(part[: n + 1]) for part in parts for n in range(len(part))
        )
    )


def _spec(name: str, near: Path) -> ModuleSpec | None:
    """Where a module is, without importing it or its package."""
    head = name.rpartition(".")[0]
    if head:
        parent = _spec(head, near)
        places = parent.submodule_search_locations if parent else None
        return PathFinder.find_spec(name, places) if places is not None else None
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        spec = None
    return spec or PathFinder.find_spec(name, [str(near)])


@cache
def installed_folders() -> frozenset[str]:
    """Folders of the standard library and of installed distributions, wherever on the
    path they were put.
    """
    known = sysconfig.get_paths()
    return frozenset(
        [known[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")]
        + [*site.getsitepackages(), site.getusersitepackages()]
        + [
            folder
            for folder in sys.path
            if folder and any(Path(folder).glob("*.dist-info"))
        ]
    )


_FIRST_READ: dict[Path, bytes] = {}


def _read_source(path: Path) -> bytes:
    """A module's source; where it has changed since this process first read it, with
    what it was then.

    A module that was imported stays what it was, so that a process with an older one is
    like no other.
    """
    content = path.read_bytes()
    first = _FIRST_READ.setdefault(path, content)
    return content if content == first else first + content


@cache
def distribution_of(package: str) -> str:
    """Name and version of the distribution that a package was installed with; empty
    where there is none.
    """
    distribution = next(iter(packages_distributions().get(package, [])), "")
    return f"{distribution} {version(distribution)}" if distribution else ""
