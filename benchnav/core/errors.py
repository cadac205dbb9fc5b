"""The errors BenchNav raises on purpose; `benchnav.core.command` prints them as one line, with exit status 2.

A message names the argument, what was expected, what came, and what to do.
"""


class BenchnavError(Exception):
    """Base of every error that a user can mend."""


class ConfigError(BenchnavError, ValueError):
    """A setting, recipe or argument is not usable as given."""


class DatasetError(BenchnavError):
    """A dataset file is missing, damaged, of another format, or lacks what was asked for."""


class CheckpointError(BenchnavError):
    """A model checkpoint is missing, damaged, or does not fit the data."""
