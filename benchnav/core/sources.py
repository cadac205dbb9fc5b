"""Import of user code by file and by name, and digests of its sources."""

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

from benchnav.core.errors import BenchnavError, ConfigError, out_of_memory_error
from benchnav.core.renamed import IMPORTS
from benchnav.core.settings import hint, one_line
from benchnav.core.shipped_files import PACKAGE


def renaming_note(error: BaseException) -> str:
    """Return a sentence that gives the new name of a renamed import.

    It is empty if the import failed for another reason.
    """
    if not isinstance(error, ImportError) or not error.name:
        return ""
    match = re.search(r"cannot import name '(\w+)'", str(error))
    old_name = f"{error.name}.{match[1]}" if match else error.name
    new_name = IMPORTS.get(old_name)
    return f". {old_name} is now {new_name}." if new_name else ""


def attribute(module: ModuleType, source: str, name: str) -> Any:
    """Return a class or function of a module.

    Args:
        module: module that defines the attribute.
        source: name or path of the module as the user wrote it, for messages.
        name: name of the attribute; dotted if it is nested in a class.

    Raises:
        ConfigError: If the module has no class or function of this name.
    """
    target: Any = module
    for part in name.split("."):
        target = getattr(target, part, None)
    if _is_class_or_function(target):
        return target
    options = {
        key: value
        for key, value in vars(module).items()
        if _is_class_or_function(value) and not key.startswith("_")
    }
    defined = [
        key
        for key, value in options.items()
        if getattr(value, "__module__", "") == module.__name__
    ]
    got = "" if target is None else f", which is an object of {type(target).__name__}"
    choices = f" ({', '.join(defined)})" if defined else ""
    raise ConfigError(
        f"Expected a class or function of {source}{choices}, got "
        f"{name!r}{got}.{hint(name, options)}"
    )


def _is_class_or_function(target: Any) -> bool:
    """Return whether an object is a class or a function, which may be wrapped.

    Other callable objects, such as a robot, do not count.
    """
    return callable(target) and (
        inspect.isclass(target)
        or inspect.isroutine(target)
        or isinstance(target, partial)
        or hasattr(target, "__wrapped__")
    )


@cache
def load_file(path: Path, content: bytes) -> ModuleType:
    """Import a file once for each content, without writing a compiled file.

    Args:
        path: absolute path of the file.
        content: present content of the file.

    Raises:
        ConfigError: If the file cannot be imported.
    """
    digest = hashlib.sha256(str(path).encode() + b"\0" + content).hexdigest()[:16]
    module = ModuleType(f"benchnav_file_{path.stem}_{digest}")
    module.__file__ = str(path)
    # Dataclasses and compiled functions look up their module in `sys.modules`.
    sys.modules[module.__name__] = module
    try:
        exec(compile(content, str(path), "exec"), vars(module))
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        if isinstance(error, BenchnavError):
            raise
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if frame.filename == str(path)]
        position = f" (line {lines[-1]})" if lines else ""
        remedy = renaming_note(error)
        if not remedy and isinstance(error, ModuleNotFoundError):
            remedy = (
                ". A file cannot import modules from its own folder: install the "
                "module, or copy its code into the file."
            )
        raise out_of_memory_error(error) or ConfigError(
            f"{path} could not be imported: {one_line(error)}{position}{remedy}"
        ) from error
    return module


def digest_of(contents: Iterable[bytes]) -> str:
    """Return the SHA-256 of the SHA-256 digests of several contents."""
    combined = hashlib.sha256()
    for content in contents:
        combined.update(hashlib.sha256(content).digest())
    return combined.hexdigest()


def digest_of_path(path: Path) -> str:
    """Return the digest of a file, or of the names and contents of a folder's files.

    It is empty if the path does not exist.

    Raises:
        ConfigError: If the path cannot be read.
    """
    try:
        if path.is_dir():
            files = [file for file in path.rglob("*") if file.is_file()]
            items = []
            for file in sorted(files):
                if "__pycache__" not in file.parts:
                    items += [file.relative_to(path).as_posix(), digest_of_path(file)]
            return digest_of(item.encode() for item in items)
        if not path.is_file():
            return ""
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise ConfigError(
            f"Expected the file {path} of a setting to be readable, got: "
            f"{error.strerror}. Change the file's permissions, or name another path."
        ) from error


def digest_of_file_and_imports(path: Path, content: bytes) -> str:
    """Return one digest of a file and of all its imports; see `imported_sources`."""
    imports = imported_sources(path.parent, "", content)
    return _digest_of_sources({"": content} | imports)


def digest_of_target(target: Callable[..., Any]) -> str:
    """Return one digest of the file that defines a class or function, and its imports.

    In a notebook, the source of the class or function replaces the file. The digest is
    empty if there is no source.
    """
    try:
        path = Path(inspect.getfile(target))
        is_file = path.is_file()
        content = path.read_bytes() if is_file else inspect.getsource(target).encode()
    except (TypeError, OSError):
        return ""
    return digest_of_file_and_imports(path, content)


def digest_of_modules(names: Iterable[str]) -> str:
    """Return one digest of the packages of modules and of all that the modules import.

    Args:
        names: names of the modules.
    """
    sources: dict[str, bytes] = {}
    for name in sorted(names):
        package = importlib.import_module(name.partition(".")[0])
        folders = [Path(folder) for folder in getattr(package, "__path__", [])]
        files: dict[str, Path] = {}
        for folder in folders:
            for file in folder.rglob("*.py"):
                files[file.relative_to(folder.parent).as_posix()] = file
        if not files and getattr(package, "__file__", None):
            files = {package.__name__: Path(str(package.__file__))}
        sources |= {key: _read_source(file) for key, file in files.items()}
        module = sys.modules.get(name)
        file = Path(getattr(module, "__file__", None) or "")
        if file.is_file():
            parent = getattr(module, "__package__", "") or ""
            sources |= imported_sources(file.parent, parent, file.read_bytes())
    return _digest_of_sources(sources)


def digests_of_package_modules(names: Iterable[str]) -> dict[str, str]:
    """Return digests of modules of benchnav and of all benchnav modules they import.

    Each digest is computed from the syntax tree without docstrings, so that comments,
    layout and documentation do not change it. A process reads each module once. Imports
    within functions count. The `__init__.py` files are excluded, because they contain
    only imports.

    Args:
        names: names of the modules to start from.

    Returns:
        Digests of 12 hexadecimal digits by module name, in alphabetical order.
    """
    digests: dict[str, str] = {}
    pending = list(names)
    while pending:
        name = pending.pop()
        entry = None if name in digests else _digest_and_imports(name)
        if entry is not None:
            digests[name], imported = entry
            pending += imported
    return dict(sorted(digests.items()))


@cache
def _digest_and_imports(name: str) -> tuple[str, tuple[str, ...]] | None:
    """Return digest and imports of a module of benchnav; None for other names."""
    path = PACKAGE.parent.joinpath(*name.split(".")).with_suffix(".py")
    if name.partition(".")[0] != PACKAGE.name or not path.is_file():
        return None
    content = path.read_bytes()
    tree = ast.parse(content)
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    for node in ast.walk(tree):
        if not isinstance(node, documented):
            continue
        if ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:]
    digest = hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:12]
    return digest, imported_names(content, "")


def _digest_of_sources(sources: Mapping[str, bytes]) -> str:
    items = []
    for name in sorted(sources):
        items += [name.encode(), sources[name]]
    return digest_of(items)


def imported_sources(folder: Path, package: str, content: bytes) -> dict[str, bytes]:
    """Return the sources of all modules that a module imports, recursively.

    The standard library, installed distributions and benchnav itself are excluded,
    because `run.json` records their versions and digests. Imports within functions
    count; imports of names that are composed at run time do not. The search imports no
    module.

    Args:
        folder: folder to search for modules, in addition to `sys.path`.
        package: package of the module; empty if it is in no package.
        content: source of the module.

    Returns:
        Sources by module name.
    """
    sources: dict[str, bytes] = {}
    excluded = {*sys.stdlib_module_names, "benchnav"}
    pending = [(package, content)]
    while pending:
        package, content = pending.pop()
        for name in imported_names(content, package):
            if name in sources or name.partition(".")[0] in excluded:
                continue
            spec = _spec(name, folder)
            if spec is None or not spec.has_location or not spec.origin:
                continue
            path = Path(spec.origin)
            if not path.is_file() or any(map(path.is_relative_to, installed_folders())):
                continue
            sources[name] = _read_source(path)
            if path.suffix == ".py":
                pending.append((spec.parent or "", path.read_bytes()))
    return sources


@cache
def imported_names(content: bytes, package: str) -> tuple[str, ...]:
    """Return the names of modules that a source may import, and of their packages.

    `from a import b` yields both `a` and `a.b`, since `b` may be a module.

    Args:
        content: source of a module.
        package: package of that module, for relative imports; may be empty.
    """
    names: list[str] = []
    try:
        tree = ast.parse(content)
    except (SyntaxError, ValueError):
        return ()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base_parts: list[str] = []
            if node.level:
                parents = package.split(".")
                base_parts = parents[: len(parents) - node.level + 1]
            if node.module:
                base_parts = [*base_parts, node.module]
            base = ".".join(base_parts)
            names.append(base)
            names += [f"{base}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and node.args:
            function = getattr(node.func, "attr", getattr(node.func, "id", ""))
            name = getattr(node.args[0], "value", None)
            is_import = function in ("import_module", "__import__")
            if is_import and isinstance(name, str):
                names.append(name)
    modules: dict[str, None] = {}  # an ordered set
    for name in names:
        if name and not name.startswith("."):
            parts = name.split(".")
            for end in range(1, len(parts) + 1):
                modules[".".join(parts[:end])] = None
    return tuple(modules)


def _spec(name: str, folder: Path) -> ModuleSpec | None:
    """Return the import spec of a module without importing it or its package.

    It is None if no module of this name exists.
    """
    package = name.rpartition(".")[0]
    if package:
        parent = _spec(package, folder)
        folders = parent.submodule_search_locations if parent else None
        return PathFinder.find_spec(name, folders) if folders is not None else None
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        spec = None
    return spec or PathFinder.find_spec(name, [str(folder)])


@cache
def installed_folders() -> frozenset[str]:
    """Return the folders of the standard library and of installed distributions."""
    paths = sysconfig.get_paths()
    folders = {paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    folders |= {*site.getsitepackages(), site.getusersitepackages()}
    for folder in sys.path:
        if folder and any(Path(folder).glob("*.dist-info")):
            folders.add(folder)
    return frozenset(folders)


# Content of each file when this process first read it.
_FIRST_CONTENTS: dict[Path, bytes] = {}


def _read_source(path: Path) -> bytes:
    """Return a module's source, for a digest.

    If the file has changed since this process first read it, the first content followed
    by the present one is returned. The process may have imported the first content, so
    the digest must differ from the digests of both contents.
    """
    content = path.read_bytes()
    first_content = _FIRST_CONTENTS.setdefault(path, content)
    return content if content == first_content else first_content + content


@cache
def distribution_of(package: str) -> str:
    """Return name and version of a package's distribution; empty if not installed."""
    distribution = next(iter(packages_distributions().get(package, [])), "")
    return f"{distribution} {version(distribution)}" if distribution else ""
