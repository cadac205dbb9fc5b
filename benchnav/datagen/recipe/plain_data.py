"""Between dataclasses and the plain data of YAML and JSON."""

import re
import sys
from copy import deepcopy
from functools import cache
from typing import Any

from benchnav.core.errors import ConfigError
from benchnav.core.options import hint, list_options


def parse(kind: type, data: Any) -> Any:
    """Builds a dataclass from plain data with jsonargparse's type checks.

    Args:
        kind: the dataclass.
        data: a mapping by field.

    Raises:
        ConfigError: a key is unknown or missing, or a value is not of its type; one line.
    """
    from jsonargparse import ArgumentError

    parser = _parser(kind)
    try:
        return parser.instantiate_classes(parser.parse_object({"value": deepcopy(data)})).value
    except (ArgumentError, TypeError, ValueError) as error:
        # "value" is the parser's name for the whole, not a key that the user wrote.
        message = re.sub(r"\bvalue\.", "", " ".join(str(error).split())).replace("Group 'value'", "It")
        raise ConfigError(_about_unknown_key(kind, message) or message) from error


@cache
def _parser(kind: type) -> Any:
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--value", type=kind, required=True)
    return parser


def plain(value: Any) -> Any:
    """Copies plain data with lists in place of tuples, as JSON reads them back."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, tuple | list) else value


def _about_unknown_key(kind: type, message: str) -> str:
    """Says which keys there are where the parser met one that it does not know; empty where it met none."""
    if found := re.fullmatch(r"It does not accept option '([^']+)'", message):
        owner, name, where = kind, found[1], ""
    elif found := re.search(r"class_path '([\w.]+)': Option '([^']+)' is not accepted", message):
        module, _, class_name = found[1].rpartition(".")
        owner, name = getattr(sys.modules[module], class_name), found[2]
        place = ".".join(re.findall(r'Parser key "(\w+)"', message[: found.start()]))
        where = f" of `{place}`" if place else ""
    else:
        return ""
    known = list_options(owner)
    return f"Expected keys{where} among {', '.join(known)}, got {name!r}.{hint(name, known)}"
