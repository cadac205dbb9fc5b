"""Between dataclasses and the plain data of YAML and JSON."""

import re
from copy import deepcopy
from typing import Any

from benchnav.errors import ConfigError


def parse(kind: type, data: Any) -> Any:
    """Builds a dataclass from plain data with jsonargparse's type checks.

    Args:
        kind: the dataclass.
        data: a mapping by field.

    Raises:
        ConfigError: a key is unknown or missing, or a value is not of its type; one line.
    """
    from jsonargparse import ArgumentError, ArgumentParser

    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--value", type=kind, required=True)
    try:
        return parser.instantiate_classes(parser.parse_object({"value": deepcopy(data)})).value
    except (ArgumentError, TypeError, ValueError) as error:
        # "value" is the parser's name for the whole, not a key that the user wrote.
        message = re.sub(r"\bvalue\.", "", " ".join(str(error).split())).replace("Group 'value'", "It")
        raise ConfigError(message) from error


def plain(value: Any) -> Any:
    """Copies plain data with lists in place of tuples, as JSON reads them back."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, tuple | list) else value
