"""Writing files whole or not at all, one writer at a time."""

import fcntl
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from benchnav.errors import BenchnavError, ConfigError


@contextmanager
def replacing(path: Path, durable: bool = True) -> Iterator[Path]:
    """Gives a name to write to; what stands there at the end takes `path`'s place in one step.

    A kill at any moment leaves `path` as it was or as it is to be. The name is the process's own, so
    that two writers of one file do not mix.

    Args:
        path: the file to be written; its folder is made.
        durable: wait until it is on the disk, so that not even a loss of power leaves it damaged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        if durable:
            with open(partial, "rb") as written:
                os.fsync(written.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def output_path(name: str) -> Path:
    """The place on this machine that a user names for an output.

    Raises:
        ConfigError: it is an address, such as s3://bucket/name, which would become a folder `s3:`.
    """
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*:/", name):
        raise ConfigError(
            f"Expected `out` as a place on this machine, got the address {name!r}. Write to a folder here, and copy it."
        )
    return Path(name).expanduser()


def write_text(path: Path, text: str) -> None:
    """Writes a text file whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(text)


def real_place(path: Path) -> Path:
    """The place that a name stands for: where a link points to; the folder that `.` is, by its own name."""
    return path.resolve() if path.is_symlink() or path.name in ("", "..") else path


@contextmanager
def sole_writer(path: Path, what: str, shared: bool = False) -> Iterator[None]:
    """Holds a file or folder for one process, whether or not it exists yet; a kill frees it.

    The lock is a file beside it, so `path` may be moved, replaced or removed while it is held.

    Args:
        path: what is held; its folder is made, and removed at the end where nothing came into it.
        what: what is written there, for the message.
        shared: hold it together with others who share it, and keep out those who do not.

    Raises:
        BenchnavError: another process, or another part of this one, holds it.
    """
    path = path.resolve()
    made = [folder for folder in path.parents if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_name(f".{path.name}.lock")
    descriptor = _take(lock, what, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
    try:
        yield
    finally:
        with suppress(BlockingIOError):  # others share it still
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Removed while it is still held: whoever opened it meanwhile sees that its name is gone.
            lock.unlink(missing_ok=True)
        os.close(descriptor)
        with suppress(OSError):  # one is not empty, or was removed by others
            for folder in made:
                folder.rmdir()


def _take(lock: Path, what: str, kind: int) -> int:
    """Opens and locks a file that has its name still; gives its descriptor."""
    while True:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
            if _is_same(descriptor, lock):
                return descriptor
        except BlockingIOError as error:
            os.close(descriptor)
            raise BenchnavError(
                f"Another run is writing {what}. Wait for it, or choose another `out`."
            ) from error
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # its holder has removed it since it was opened


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
