"""Compilation of the C code, and the compiled library.

The code is compiled at first use, against the headers of the installed MuJoCo, into a
cache. A library's name contains a digest of everything that determines it: the sources,
the compiler and its flags, the version of MuJoCo and the machine.
"""

import ctypes
import hashlib
import os
import platform
import shlex
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from benchnav.core.errors import ConfigError, expect

FOLDER = Path(__file__).parent

_SOURCES = ("drive.c", "wheel.h")
# Reordered or contracted arithmetic would change results between compilers.
_FLAGS = ("-O2", "-ffp-contract=off", "-fPIC", "-shared")
_LAST_LINES = 3  # of a compiler's messages


def import_mujoco() -> Any:
    """Return the module `mujoco`.

    Raises:
        ConfigError: If MuJoCo is missing, or its version is not supported.
    """
    try:
        import mujoco
    except ImportError as error:
        raise ConfigError(
            "Expected MuJoCo for `world.backend` 'physics', got no module `mujoco`. "
            "Install it: pip install 'benchnav[physics]'."
        ) from error
    version = mujoco.__version__
    if version.split(".")[0] != "4":
        raise ConfigError(
            f"Expected MuJoCo 4 for `world.backend` 'physics', got {version}. "
            "Install it: pip install 'mujoco>=4,<5'."
        )
    return mujoco


def file_digest(what: str, file: str, stored: str) -> str:
    """Return the first digits of a file's SHA-256.

    Args:
        what: kind of file, for messages.
        file: path.
        stored: digest that the file must have; empty for any.

    Raises:
        ConfigError: If the file cannot be read, or has another digest than `stored`.
    """
    try:
        content = Path(file).read_bytes()
    except OSError as error:
        raise ConfigError(
            f"Expected {what} as a file, got {file}, which cannot be read: "
            f"{error.strerror}. Correct the path."
        ) from error
    digest = hashlib.sha256(content).hexdigest()[:16]
    expect(
        stored in ("", digest),
        f"{what} {file} with digest {stored}, got {digest}. Restore the file, or "
        "remove `digest`.",
    )
    return digest


def cache_folder() -> Path:
    """Return the folder of compiled libraries.

    It is `physics` in `$BENCHNAV_CACHE`, by default in `benchnav` in `$XDG_CACHE_HOME`,
    by default `~/.cache`.
    """
    own = os.environ.get("BENCHNAV_CACHE")
    if own:
        return Path(own) / "physics"
    shared = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(shared) / "benchnav" / "physics"


@cache
def load_library(law: Path) -> ctypes.CDLL:
    """Return the library of a soil law, which is compiled if the cache has none.

    Args:
        law: C file that defines `soil_force`; see wheel.h.

    Raises:
        ConfigError: If MuJoCo or a compiler is missing, or the code does not compile.
    """
    mujoco = import_mujoco()
    package = Path(mujoco.__file__).parent
    # The symbols of MuJoCo become visible, so that our library uses the same MuJoCo as
    # Python, wherever it is installed.
    ctypes.CDLL(str(_library_of(package)), mode=ctypes.RTLD_GLOBAL)
    compiler = _compiler()
    sources = [(FOLDER / name).read_bytes() for name in _SOURCES]
    sources.append(law.read_bytes())
    parts = [*sources, " ".join(compiler).encode(), _version_of(compiler)]
    parts += [mujoco.__version__.encode(), platform.machine().encode()]
    parts += [" ".join(_FLAGS).encode()]
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    path = cache_folder() / f"{law.stem}-{digest.hexdigest()[:16]}.so"
    if not path.exists():
        _compile(compiler, law, package / "include", path)
    return ctypes.CDLL(str(path))


def _compile(compiler: list[str], law: Path, include: Path, path: Path) -> None:
    """Compile to a temporary file, then rename it, so that processes do not clash."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    except OSError as error:
        raise ConfigError(
            f"Expected a folder for compiled code, got {path.parent}, which cannot be "
            f"written: {error.strerror}. Set BENCHNAV_CACHE to another folder."
        ) from error
    os.close(handle)
    platform_flags: list[str] = []
    if sys.platform == "darwin":
        platform_flags = ["-undefined", "dynamic_lookup"]
    command = [*compiler, *_FLAGS, *platform_flags, f"-I{include}", f"-I{FOLDER}"]
    command += [str(FOLDER / "drive.c"), str(law), "-o", name, "-lm"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode != 0:
            lines = result.stderr.strip().splitlines()
            errors = [line for line in lines if "error" in line] or lines
            raise ConfigError(
                f"Expected a soil law that {compiler[0]} compiles, got {law}: "
                f"{' '.join(errors[:_LAST_LINES])}"
            )
        os.replace(name, path)
    finally:
        Path(name).unlink(missing_ok=True)


def _compiler() -> list[str]:
    """Return the command of the C compiler: `$CC`, by default `cc`."""
    return shlex.split(os.environ.get("CC", "")) or ["cc"]


def _version_of(compiler: list[str]) -> bytes:
    """Return what a compiler prints as its version.

    Raises:
        ConfigError: If there is no such compiler.
    """
    command = [*compiler, "--version"]
    try:
        return subprocess.run(command, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        raise ConfigError(
            f"Expected a C compiler for `world.backend` 'physics', got {compiler[0]!r}, "
            "which does not run. Install one (Debian: apt install gcc; macOS: "
            "xcode-select --install), or set CC to its command."
        ) from error


def _library_of(package: Path) -> Path:
    """Return the shared library of an installed MuJoCo."""
    found = sorted(package.glob("libmujoco*.so*")) + sorted(
        package.glob("libmujoco*.dylib")
    )
    if not found:
        raise ConfigError(
            f"Expected MuJoCo's library in {package}, got none. Install MuJoCo from "
            "PyPI: pip install 'benchnav[physics]'."
        )
    return found[0]
