"""Errors of BenchNav; `benchnav.core.command` prints them as one line and exits.

A message states the argument, the expectation, the value and the remedy.
"""

import errno
import logging
import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from typing import ClassVar


class BenchnavError(Exception):
    """Base class of errors that a user can fix."""

    status: ClassVar[int] = 2
    """Exit status of a command that ends with it."""


class ConfigError(BenchnavError, ValueError):
    """A setting, recipe or argument is invalid."""


class TrainingError(BenchnavError):
    """A training failed although its settings are valid."""

    status: ClassVar[int] = 1


def expect(is_valid: object, what: str) -> None:
    """Raise an error unless a setting, recipe or argument is valid.

    Args:
        is_valid: whether it is valid.
        what: argument, expectation, value and remedy, which continue "Expected".

    Raises:
        ConfigError: If it is not valid.
    """
    if not is_valid:
        raise ConfigError(f"Expected {what}")


def choose(
    what: str, requested: Collection[str] | None, options: Iterable[str]
) -> list[str]:
    """Return the requested options in their own order.

    Args:
        what: name of the argument in messages.
        requested: requested options; if None, all.
        options: all options.

    Raises:
        ConfigError: If no option is requested, or one that does not exist.
    """
    options = list(options)
    requested = options if requested is None else requested
    unknown = [name for name in requested if name not in options]
    is_valid = requested and not unknown
    expect(is_valid, f"`{what}` among {options}, got {unknown or 'none'}.")
    return [name for name in options if name in requested]


# NUL ends a path, other control characters move the cursor of a terminal; surrogates
# stand for bytes that are not UTF-8.
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")


def check_text(text: str, location: str = "") -> None:
    """Reject text with control characters except for tabs and line breaks.

    Args:
        text: text from a user.
        location: location of the text in messages.

    Raises:
        ConfigError: If it contains control characters, or bytes that are not UTF-8.
    """
    where = f" in {location}" if location else ""
    expect(
        not _CONTROL.search(text),
        f"text in UTF-8 without control characters{where}, got {text!r}. Leave them "
        "out.",
    )


def check_label(what: str, text: str) -> None:
    """Reject text that a table cannot show: empty, unprintable or of several lines.

    Args:
        what: meaning of the text in messages.
        text: text from a user.

    Raises:
        ConfigError: If the text is invalid.
    """
    expect(
        text.strip() and text.isprintable(),
        f"{what} as printable text on one line, got {text!r}.",
    )


class OutOfMemoryError(BenchnavError):
    """Memory ran out; only the size of the input is at fault."""


# Messages of PyTorch, HDF5 and C++, which do not raise `MemoryError`.
_NO_MEMORY = re.compile(
    r"can't allocate memory|cannot allocate memory|not enough memory|out of memory|std::bad_alloc|unable to allocate",
    re.IGNORECASE,
)


def out_of_memory(error: BaseException) -> OutOfMemoryError | None:
    """Return the error to raise if an error or its cause is a lack of memory."""
    if isinstance(error, BenchnavError) and _NO_MEMORY.search(str(error)):
        return None  # its message already states it
    cause: BaseException | None = error
    seen: set[int] = set()  # an error may be its own cause
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        if isinstance(cause, OutOfMemoryError):
            return cause
        if _is_out_of_memory(cause):
            text = " ".join(str(cause).split())[:200].rstrip(".")
            return OutOfMemoryError(
                f"Memory ran out ({text or type(cause).__name__}). Ask for less at "
                "once: fewer `jobs`, samples or maps of a batch, smaller maps or a "
                "smaller network."
            )
        cause = cause.__cause__
    return None


def _is_out_of_memory(error: BaseException) -> bool:
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    is_runtime = isinstance(error, RuntimeError | OSError)
    return is_runtime and _NO_MEMORY.search(str(error)) is not None


class DatasetError(BenchnavError):
    """A dataset file is missing, damaged, of another format or incomplete."""


class CheckpointError(BenchnavError):
    """A model checkpoint is missing, damaged, or does not fit the data."""


@contextmanager
def quiet(*loggers: str) -> Iterator[None]:
    """Silence loggers of libraries; errors that matter to a user are raised."""
    levels = {name: logging.getLogger(name).level for name in loggers}
    for name in loggers:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
