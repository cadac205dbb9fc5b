"""The errors BenchNav raises on purpose; `benchnav.core.command` prints them as one line, with exit status 2.

A message names the argument, what was expected, what came, and what to do.
"""

import logging
from collections.abc import Iterator
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
