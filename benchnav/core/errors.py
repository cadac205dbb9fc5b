"""The errors BenchNav raises on purpose; `benchnav.core.command` prints them as one
line, and exits with their status.

A message names the argument, what was expected, what came, and what to do.
"""

import errno
import logging
import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from typing import ClassVar


class BenchnavError(Exception):
    """Base of every error that a user can mend."""

    status: ClassVar[int] = 2
    """Exit status of a command that ends with it."""


class ConfigError(BenchnavError, ValueError):
    """A setting, recipe or argument is not usable as given."""


class TrainingError(BenchnavError):
    """A training failed on its way, after usable settings."""

    status: ClassVar[int] = 1


def expect(holds: object, what: str) -> None:
    """Refuses a setting, recipe or argument that is not usable.

    Args:
        holds: whether it is.
        what: the argument, what was expected, what came and what to do, in a sentence
            that goes on from "Expected".

    Raises:
        ConfigError: it is not.
    """
    if not holds:
        raise ConfigError(f"Expected {what}")


def choose(what: str, asked: Collection[str] | None, known: Iterable[str]) -> list[str]:
    """Gives what is asked for of what there is, in the order of that; None asks for
    all.

    Raises:
        ConfigError: nothing is asked for, or something that is not there, of the
            argument `what`.
    """
    known = list(known)
    asked = known if asked is None else asked
    unknown = [name for name in asked if name not in known]
    expect(asked and not unknown, f"`{what}` among {known}, got {unknown or 'none'}.")
    return [name for name in known if name in asked]


# NUL ends a path, others move the cursor of a terminal; surrogates stand for bytes that
# are no UTF-8.
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")


def check_text(text: str, place: str = "") -> None:
    """Refuse text that no name, path or setting holds: control characters but for tab
    and line break.

    Args:
        text: what a user wrote.
        place: where it stands, for the message.

    Raises:
        ConfigError: If it holds such a character, or bytes that are no UTF-8.
    """
    where = f" in {place}" if place else ""
    expect(
        not _CONTROL.search(text),
        f"text in UTF-8 without control characters{where}, got {text!r}. Leave them "
        "out.",
    )


def check_label(what: str, text: str) -> None:
    """Refuse what no table can show: text that is empty, or has a line break or a
    character that is not printed.

    Args:
        what: what is called by the text.
        text: what a user wrote.

    Raises:
        ConfigError: If it is such.
    """
    expect(
        text.strip() and text.isprintable(),
        f"{what} as printable text on one line, got {text!r}.",
    )


class OutOfMemoryError(BenchnavError):
    """Memory ran out; nothing that was given is to blame but its size."""


# What PyTorch, HDF5 and C++ say where `MemoryError` is not what they raise.
_NO_MEMORY = re.compile(
    r"can't allocate memory|cannot allocate memory|not enough memory|out of memory|std::bad_alloc|unable to allocate",
    re.IGNORECASE,
)


def out_of_memory(error: BaseException) -> OutOfMemoryError | None:
    """Return what to say where an error, or one that it was raised from, is that memory
    ran out; else None.
    """
    if isinstance(error, BenchnavError) and _NO_MEMORY.search(str(error)):
        return None  # which says so
    cause: BaseException | None = error
    seen: set[int] = set()  # an error may be its own cause
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        if isinstance(cause, OutOfMemoryError):
            return cause
        is_known = (
            isinstance(cause, MemoryError)
            or getattr(cause, "errno", None) == errno.ENOMEM
        )
        if is_known or (
            isinstance(cause, RuntimeError | OSError) and _NO_MEMORY.search(str(cause))
        ):
            said = (
                " ".join(str(cause).split())[:200].rstrip(".") or type(cause).__name__
            )
            return OutOfMemoryError(
                f"Memory ran out ({said}). Ask for less at once: fewer `jobs`, "
                "samples or maps of a batch, smaller "
                "maps or a smaller network."
            )
        cause = cause.__cause__
    return None


class DatasetError(BenchnavError):
    """A dataset file is missing, damaged, of another format, or lacks what was asked
    for.
    """


class CheckpointError(BenchnavError):
    """A model checkpoint is missing, damaged, or does not fit the data."""


@contextmanager
def quiet(*loggers: str) -> Iterator[None]:
    """Keeps what libraries log off the terminal; what a user has to know is raised."""
    levels = {name: logging.getLogger(name).level for name in loggers}
    for name in loggers:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
