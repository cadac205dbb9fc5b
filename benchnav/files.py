"""Writing files whole or not at all, one writer at a time."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchnav.errors import BenchnavError


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


def write_text(path: Path, text: str) -> None:
    """Writes a text file whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(text)


@contextmanager
def sole_writer(folder: Path, what: str) -> Iterator[None]:
    """Holds a folder for one process; a kill frees it.

    Args:
        folder: must exist.
        what: what is written there, for the message.

    Raises:
        BenchnavError: another process holds it.
    """
    with open(folder / ".lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BenchnavError(
                f"Another run is writing {what}. Wait for it, or choose another `out`."
            ) from error
        yield
