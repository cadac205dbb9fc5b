"""Options of a class or function: what they are, and values of their types from plain data.

The keyword parameters of a class or function are its options; where its one parameter is a dataclass named
`config`, the fields of that are. A dataclass within is given as a mapping.
"""

import difflib
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass
from enum import Enum
from pathlib import PurePath
from types import MappingProxyType, NoneType, SimpleNamespace, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from benchnav.core.errors import BenchnavError, ConfigError

NO_DEFAULT = inspect.Parameter.empty

# Names of earlier versions, with those of today.
RENAMED = {
    **{
        "steps": "record",
        "instances": "maps",
        "instance": "map",
        "trials": "conditions",
        "slowest": "min_traversability",
    },
    **{"recorded": "record", "split": "splits"},
}

_UNNAMED = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


@dataclass(frozen=True, kw_only=True)
class Option:
    """One option of a part.

    Args:
        kind: its type, as annotated; `Any` where it is not.
        default: `NO_DEFAULT` where it has to be given.
    """

    kind: Any
    default: Any


def list_options(target: Callable[..., Any], skipped: Iterable[str] = ()) -> dict[str, Option]:
    """Lists options by name, in order.

    Args:
        target: a class, or a function.
        skipped: names of parameters that are no options.
    """
    target = config_class(target, skipped) or target
    if is_dataclass(target):
        types = _types(target)
        found = {
            item.name: Option(kind=types.get(item.name, Any), default=_default(item))
            for item in fields(target)
            if item.init
        }
    else:
        types = _types(target.__init__ if inspect.isclass(target) else target)
        found = {
            name: Option(kind=types.get(name, Any), default=parameter.default)
            for name, parameter in parameters(target).items()
        }
    return {name: option for name, option in found.items() if name not in set(skipped)}


def config_class(target: Callable[..., Any], skipped: Iterable[str] = ()) -> Any:
    """The dataclass of a sole parameter `config`; None where there is no such parameter."""
    if [name for name in parameters(target) if name not in set(skipped)] != ["config"]:
        return None
    return dataclass_in(_types(target.__init__ if inspect.isclass(target) else target).get("config"))


def parameters(target: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Parameters that have names of their own; a class without a constructor has none."""
    if inspect.isclass(target) and target.__init__ is object.__init__:
        return {}
    return {n: p for n, p in inspect.signature(target).parameters.items() if p.kind not in _UNNAMED}


def dataclass_in(kind: Any) -> Any:
    """The dataclass that a type is or, as in `Config | None`, holds; None where there is none."""
    members = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    return next((member for member in members if isinstance(member, type) and is_dataclass(member)), None)


def typed(owner: str, name: str, option: Option, value: Any) -> Any:
    """Gives a value of an option's type.

    Args:
        owner: whose option it is, for messages, such as "planner 'mppi'".
        name: of the option; of those of a dataclass within, with dots.
        option: what is expected.
        value: plain data, or a value of the type; text is read as the command line reads it.

    Raises:
        ConfigError: the value is of another type.
    """
    config = dataclass_in(option.kind)
    if config and isinstance(value, Mapping):
        known = list_options(config)
        refuse_unknown(owner, value, known, f"{name}.", gone_options(config))
        given = {key: typed(owner, f"{name}.{key}", known[key], item) for key, item in value.items()}
        return call(f"option {name!r} of {owner}", config, given)
    if option.kind is Any or (isinstance(option.kind, type) and type(value) is option.kind):
        return value
    try:
        return _parsed(option.kind, value)
    except (ValueError, TypeError) as error:
        default = "" if option.default in (NO_DEFAULT, None) else f" such as {option.default!r}"
        raise ConfigError(
            f"Expected option {name!r} of {owner} as {type_name(option.kind)}{default}, got {value!r}."
        ) from error


def from_text(owner: str, name: str, option: Option, text: str) -> Any:
    """Reads an option's value from text; arguments as of `typed`. Without a type it is read as YAML.

    Raises:
        ConfigError: the value is of another type.
    """
    if option.kind is not Any:
        return typed(owner, name, option, text)
    from jsonargparse import get_loader

    return get_loader("yaml")(text)


def gone_options(target: Callable[..., Any], skipped: Iterable[str] = ()) -> Mapping[str, str]:
    """Options that were once there and what does their work now: `gone` of a class or of its `config`."""
    return getattr(config_class(target, skipped) or target, "gone", {})


def refuse_unknown(
    owner: str,
    given: Mapping[str, Any],
    known: Mapping[str, Option],
    prefix: str = "",
    gone: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Refuses names that are no options, with what does their work now or the nearest name that is one.

    Raises:
        ConfigError: there is such a name.
    """
    for name in map(str, given):
        if name not in known:
            among = f"among {', '.join(prefix + other for other in known)}" if known else "none: it has none"
            remedy = f" {gone[name]}" if name in gone else hint(name, known, prefix)
            raise ConfigError(f"Expected options of {owner} {among}; got {prefix + name!r}.{remedy}")


def call(what: str, target: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """Calls a user's class or function; whatever it raises ends in one line.

    Raises:
        ConfigError: it refuses its arguments.
    """
    try:
        return target(**arguments)
    except BenchnavError:
        raise
    except Exception as error:
        raise ConfigError(f"{what} could not be made: {one_line(error)}") from error


def one_line(error: BaseException) -> str:
    """An error as one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def plain(value: Any) -> Any:
    """Gives a value as plain data for JSON.

    Raises:
        ConfigError: it is something else.
    """
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, bool | int | float | str | NoneType):
        return value
    raise ConfigError(f"Expected plain data (numbers, text, lists, mappings), got {value!r}.")


def type_name(kind: Any) -> str:
    """A type as people write it."""
    members = get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return " | ".join(map(type_name, members))
    if kind is NoneType:
        return "None"
    return kind.__name__ if isinstance(kind, type) and not members else str(kind).replace("typing.", "")


def hint(name: str, known: Iterable[str], prefix: str = "") -> str:
    """A sentence with today's name or the nearest known one, beginning with a space; empty where none is near."""
    known = list(known)
    old = re.split(r"[-.]", name)[-1]
    now = name.removesuffix(old) + RENAMED.get(old, old)
    if now != name and now in known:
        return f" It is now {prefix + now!r}."
    close = difflib.get_close_matches(name, known, n=1)
    return f" Did you mean {prefix + close[0]!r}?" if close else ""


def _parsed(kind: Any, value: Any) -> Any:
    from jsonargparse import ArgumentError, ArgumentParser

    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--value", type=kind)
    try:
        return parser.instantiate(parser.parse_object({"value": value})).value
    except ArgumentError as error:
        raise ValueError(one_line(error)) from error


def _types(target: Any) -> dict[str, Any]:
    """Annotations as types; one that cannot be told, such as a name imported for type checkers, is left out."""
    try:
        return get_type_hints(target)
    except Exception:
        names = getattr(target, "__globals__", None) or vars(sys.modules.get(target.__module__, target))
        found: dict[str, Any] = {}
        for name, annotation in inspect.get_annotations(target).items():
            try:
                found |= get_type_hints(SimpleNamespace(__annotations__={name: annotation}), names)
            except Exception:
                continue
        return found


def _default(item: Any) -> Any:
    if item.default is not MISSING:
        return item.default
    return item.default_factory() if item.default_factory is not MISSING else NO_DEFAULT
