"""The errors BenchNav raises on purpose; `benchnav.core.command` prints them as one line, with exit status 2.

A message names the argument, what was expected, what came, and what to do.
"""

import logging
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager


class BenchnavError(Exception):
    """Base of every error that a user can mend."""


class ConfigError(BenchnavError, ValueError):
    """A setting, recipe or argument is not usable as given."""


def expect(holds: object, what: str) -> None:
    """Refuses a setting, recipe or argument that is not usable.

    Args:
        holds: whether it is.
        what: the argument, what was expected, what came and what to do, in a sentence that goes on from "Expected".

    Raises:
        ConfigError: it is not.
    """
    if not holds:
        raise ConfigError(f"Expected {what}")


def choose(what: str, asked: Collection[str] | None, known: Iterable[str]) -> list[str]:
    """Gives what is asked for of what there is, in the order of that; None asks for all.

    Raises:
        ConfigError: nothing is asked for, or something that is not there, of the argument `what`.
    """
    known = list(known)
    asked = known if asked is None else asked
    unknown = [name for name in asked if name not in known]
    expect(asked and not unknown, f"`{what}` among {known}, got {unknown or 'none'}.")
    return [name for name in known if name in asked]


class DatasetError(BenchnavError):
    """A dataset file is missing, damaged, of another format, or lacks what was asked for."""


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
