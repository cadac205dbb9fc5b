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
    """Exit status of a command that ends with this error."""


class ConfigError(BenchnavError, ValueError):
    """A setting, recipe or argument is invalid."""


class TrainingError(BenchnavError):
    """A training failed although its settings are valid."""

    status: ClassVar[int] = 1


def expect(is_valid: object, what: str) -> None:
    """Raise an error unless a setting, recipe or argument is valid.

    Args:
        is_valid: whether the setting, recipe or argument is valid.
        what: rest of the message after "Expected": argument, expectation, value and
            remedy.

    Raises:
        ConfigError: If `is_valid` is false.
    """
    if not is_valid:
        raise ConfigError(f"Expected {what}")


def choose(
    what: str, requested: Collection[str] | None, options: Iterable[str]
) -> list[str]:
    """Return the requested options in the order of all options.

    Args:
        what: name of the argument in messages.
        requested: requested options; if None, all options.
        options: all options.

    Raises:
        ConfigError: If `requested` is empty, or contains an option that does not exist.
    """
    options = list(options)
    requested = options if requested is None else requested
    unknown = [name for name in requested if name not in options]
    is_valid = requested and not unknown
    expect(is_valid, f"`{what}` among {options}, got {unknown or 'none'}.")
    return [name for name in options if name in requested]


# NUL ends a path, and other control characters move the cursor of a terminal.
# Surrogates represent bytes that are not UTF-8.
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")


def check_text(text: str, location: str = "") -> None:
    """Reject text with control characters except for tabs and line breaks.

    Args:
        text: text from a user.
        location: location of the text in messages; may be empty.

    Raises:
        ConfigError: If the text contains control characters, or bytes that are not
            UTF-8.
    """
    where = f" in {location}" if location else ""
    expect(
        not _CONTROL.search(text),
        f"text in UTF-8 without control characters{where}, got {text!r}. Remove these "
        "characters.",
    )


def check_label(what: str, text: str) -> None:
    """Reject text that a table cannot show: empty, unprintable or of several lines.

    Args:
        what: name of the text in messages.
        text: text from a user.

    Raises:
        ConfigError: If the text is invalid.
    """
    expect(
        text.strip() and text.isprintable(),
        f"{what} as printable text on one line, got {text!r}.",
    )


class OutOfMemoryError(BenchnavError):
    """Memory ran out; the input is valid but too large."""


# Messages of PyTorch, HDF5 and C++ about a lack of memory, which is not a `MemoryError`.
_NO_MEMORY = re.compile(
    r"can't allocate memory|cannot allocate memory|not enough memory|out of memory|std::bad_alloc|unable to allocate",
    re.IGNORECASE,
)


def out_of_memory_error(error: BaseException) -> OutOfMemoryError | None:
    """Return an `OutOfMemoryError` if an error or its cause is a lack of memory.

    Otherwise, return None.
    """
    if isinstance(error, BenchnavError) and _NO_MEMORY.search(str(error)):
        return None  # the message already states the lack of memory
    cause: BaseException | None = error
    seen: set[int] = set()  # an error may be its own cause
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        if isinstance(cause, OutOfMemoryError):
            return cause
        if _is_out_of_memory(cause):
            text = " ".join(str(cause).split())[:200].rstrip(".")
            return OutOfMemoryError(
                f"Memory ran out ({text or type(cause).__name__}). Use fewer `jobs`, "
                "fewer samples, fewer maps per batch, smaller maps or a smaller network."
            )
        cause = cause.__cause__
    return None


def _is_out_of_memory(error: BaseException) -> bool:
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    is_runtime = isinstance(error, RuntimeError | OSError)
    return is_runtime and _NO_MEMORY.search(str(error)) is not None


class DatasetError(BenchnavError):
    """A dataset file is missing, damaged, incomplete or has another format."""


class CheckpointError(BenchnavError):
    """A model checkpoint is missing, damaged, or does not fit the data."""


@contextmanager
def quiet(*loggers: str) -> Iterator[None]:
    """Silence loggers of libraries by name; exceptions are still raised."""
    levels = {name: logging.getLogger(name).level for name in loggers}
    for name in loggers:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
