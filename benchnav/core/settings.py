"""Conversion of plain data into typed settings, and back.

Plain data comes from YAML, JSON and command lines. It becomes dataclasses and options of
parts. The options of a class or function are its keyword parameters. If its only
parameter is a dataclass named `config`, the fields of `config` are the options. A value
is read according to its annotated type. This module reads dataclasses, key by key, so
that messages name the invalid key; jsonargparse reads all other types.
"""

import difflib
import inspect
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from enum import Enum
from functools import cache, partial
from pathlib import PurePath
from types import NoneType, SimpleNamespace
from typing import Any, get_args, get_origin, get_type_hints

from benchnav.core.annotations import dataclass_in as dataclass_in
from benchnav.core.annotations import in_words as in_words
from benchnav.core.annotations import members_of as members_of
from benchnav.core.errors import BenchnavError, ConfigError, out_of_memory_error
from benchnav.core.yaml_text import MAX_DEPTH, check_yaml

NO_DEFAULT = inspect.Parameter.empty

# Function from a dotted key to its name in messages; an empty key means all settings.
Naming = Callable[[str], str]

_UNNAMED = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


@dataclass(frozen=True, kw_only=True)
class Option:
    """Type and default of an option.

    Args:
        kind: annotated type; `Any` if there is no annotation.
        default: default value; `NO_DEFAULT` if the option is required.
    """

    kind: Any
    default: Any


# --- options of classes and functions ---


def list_options(
    target: Callable[..., Any], skipped: Iterable[str] = ()
) -> dict[str, Option]:
    """Return options by name, in the order of their parameters.

    Args:
        target: a class or function.
        skipped: names of parameters that are not options.
    """
    skipped = set(skipped)
    target = config_class(target, skipped) or target
    types = _types(target)
    factories: dict[str, Any] = {}
    if is_dataclass(target):
        factories = {field.name: field.default_factory for field in fields(target)}
    options = {}
    for name, parameter in parameters(target).items():
        if name in skipped:
            continue
        default = parameter.default
        factory = factories.get(name, MISSING)
        if factory is not MISSING:
            default = factory()
        options[name] = Option(kind=types.get(name, Any), default=default)
    return options


def config_class(target: Callable[..., Any], skipped: Iterable[str] = ()) -> Any:
    """Return the dataclass of `config` if that is the only parameter, else None."""
    if set(parameters(target)) - set(skipped) != {"config"}:
        return None
    return dataclass_in(_types(target).get("config"))


def parameters(target: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return parameters by name, except `*args` and `**kwargs`."""
    if inspect.isclass(target) and target.__init__ is object.__init__:
        return {}
    return {
        name: parameter
        for name, parameter in inspect.signature(target).parameters.items()
        if parameter.kind not in _UNNAMED
    }


def _types(target: Any) -> dict[str, Any]:
    """Return types of parameters by name, except those that cannot be resolved.

    A type cannot be resolved if it is imported only for type checkers.
    """
    if inspect.isclass(target) and not is_dataclass(target):
        target = target.__init__
    try:
        return get_type_hints(target)
    except Exception:
        names = getattr(target, "__globals__", None) or vars(
            sys.modules.get(target.__module__, target)
        )
        types: dict[str, Any] = {}
        for name, annotation in inspect.get_annotations(target).items():
            annotated = SimpleNamespace(__annotations__={name: annotation})
            with suppress(Exception):
                types |= get_type_hints(annotated, names)
        return types


def call(what: str, target: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """Call a user's class or function; convert its exceptions to `ConfigError`.

    Args:
        what: name of the result in messages.
        target: the class or function.
        arguments: keyword arguments.

    Raises:
        ConfigError: If the call raises an exception other than a `BenchnavError`.
    """
    try:
        return target(**arguments)
    except BenchnavError:
        raise
    except Exception as error:
        raise out_of_memory_error(error) or ConfigError(
            f"{what} could not be created: {one_line(error)}"
        ) from error


# --- from plain data ---


def of(owner: str) -> Naming:
    """Return a function that names keys of an owner, such as "planner 'mppi'"."""
    return lambda key: f"`{key}` of {owner}" if key else owner


def read(
    kind: Any, value: Any, name: Naming, key: str = "", present: Any = NO_DEFAULT
) -> Any:
    """Return a value converted to a type.

    Args:
        kind: annotated type.
        value: plain data, or a value of the type; text is parsed as on the command line.
        name: function from a key to its name in messages.
        key: dotted key of the value; empty for all settings.
        present: present value, which `value` replaces. If it is a dataclass, only the
            fields in `value` are replaced.

    Raises:
        ConfigError: If a key is unknown or missing, a value has a different type, or the
            dataclass rejects it.
    """
    _check_size(value, name(key))
    if (
        kind is Any
        or (isinstance(kind, type) and type(value) is kind)
        or (value is None and present is None)
    ):
        return value
    config = dataclass_in(kind)
    origin = get_origin(kind)
    members = get_args(kind)
    if config and isinstance(value, Mapping):
        base = present if isinstance(present, config) else None
        before = None
        if base is not None:
            before = {field.name: getattr(base, field.name) for field in fields(base)}
        arguments = read_options(list_options(config), value, name, key, before)
        create = partial(replace, base) if base else config
        return call(name(key), create, arguments)
    if origin is dict and dataclass_in(members[1]) and isinstance(value, Mapping):
        if not all(isinstance(inner, str) for inner in value):
            raise ConfigError(
                f"Expected keys of {name(key)} as text, got {list(value)}. Put numbers "
                "in quotes."
            )
        return {
            inner: read(members[1], item, name, f"{key}.{inner}")
            for inner, item in value.items()
        }
    if (
        origin in (list, tuple)
        and any(map(dataclass_in, members[:1]))
        and isinstance(value, list | tuple)
    ):
        named = zip(_names(value), value, strict=True)
        return origin(
            read(members[0], item, name, f"{key}.{inner}") for inner, item in named
        )
    if value is None and NoneType in members:
        return None
    data = value
    if isinstance(value, str) and kind is not str:
        allowed = members_of(kind)
        is_list = str not in allowed and any(
            get_origin(member) in (list, tuple) for member in allowed
        )
        if is_list and not value.lstrip().startswith(("[", "(")):
            data = f"[{value}]"
        check_yaml(data)  # the parser checks neither duplicate keys nor nesting
    try:
        parsed = _parsed(kind, data)
    except ValueError as error:
        got = "null" if value is None else repr(value)
        choices = [member for member in members_of(kind) if isinstance(member, str)]
        remedy = hint(str(value), choices)
        raise ConfigError(
            f"Expected {name(key)} as {in_words(kind)}, got {got}.{remedy}"
        ) from error
    _check_size(parsed, name(key))
    return parsed


def _check_size(value: Any, what: str) -> None:
    """Reject integers of more than 64 bits, which arrays and generators cannot store."""
    if type(value) is int and abs(value) >= 2**64:
        raise ConfigError(
            f"Expected {what} as a whole number of at most 64 bits, got a "
            f"number of {value.bit_length()} bits."
        )


def read_options(
    options: Mapping[str, Option],
    values: Mapping[str, Any],
    name: Naming,
    key: str = "",
    present: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return values converted to the types of their options, by name.

    Args:
        options: available options by name.
        values: plain data by name of the option.
        name: function from a key to its name in messages.
        key: dotted key of all options; empty for all settings.
        present: present values by name; if None, options without a default are required.

    Raises:
        ConfigError: If an option is unknown or missing, or `read` rejects its value.
    """
    inner = f"{key}." if key else ""
    for option_name in map(str, values):
        if option_name in options:
            continue
        if not options:
            raise ConfigError(
                f"Expected no options for {name(key)}, got {option_name!r}."
            )
        raise ConfigError(
            f"Expected keys of {name(key)} among {', '.join(options)}, got "
            f"{option_name!r}.{hint(option_name, options)}"
        )
    for option_name, option in options.items():
        is_required = option.default is NO_DEFAULT and present is None
        if is_required and option_name not in values:
            expected = f"{name(inner + option_name)} as {in_words(option.kind)}"
            raise ConfigError(f"Expected {expected}, got none.")
    before = {option_name: option.default for option_name, option in options.items()}
    before |= present or {}
    converted = {}
    for option_name, value in values.items():
        kind = options[option_name].kind
        full_key = inner + option_name
        converted[option_name] = read(kind, value, name, full_key, before[option_name])
    return converted


def changed(data: Any, path: Sequence[str], value: Any) -> Any:
    """Return a copy of plain data with one value set.

    Args:
        data: nested mappings and lists. An item of a list is identified by its `name`,
            as a terrain class is, or by its index.
        path: keys of nested mappings and lists that lead to the value; missing mappings
            are created.
        value: new value, plain data.

    Raises:
        ConfigError: If `path` is too long, or leads through a value without keys.
    """
    if len(path) > MAX_DEPTH:
        raise ConfigError(
            f"Expected at most {MAX_DEPTH} keys, separated by dots, got {len(path)}."
        )
    if not path:
        return value
    key = path[0]
    remaining = path[1:]
    if isinstance(data, list):
        names = _names(data)
        if key not in names:
            raise ConfigError(
                f"Expected a name among {', '.join(names)}, got "
                f"{key!r}.{hint(key, names)}"
            )
        return [
            changed(item, remaining, value) if name == key else item
            for name, item in zip(names, data, strict=True)
        ]
    if not isinstance(data, Mapping | None):
        raise ConfigError(
            f"Expected a mapping in which {'.'.join(path)!r} can be set, got {data!r}."
        )
    mapping = data or {}
    return {**mapping, key: changed(mapping.get(key), remaining, value)}


def _names(items: Sequence[Any]) -> list[str]:
    """Return the identifier of each item of a list: its `name`, or its index."""
    return [
        str(item.get("name", index)) if isinstance(item, Mapping) else str(index)
        for index, item in enumerate(items)
    ]


def _parsed(kind: Any, value: Any) -> Any:
    from jsonargparse import ArgumentError

    try:
        parser = _parser(kind)
        # The parser would treat null as a missing value and, for a dataclass, any value
        # that is not a mapping.
        if value is None or is_dataclass(kind):
            raise ValueError
        return parser.instantiate(parser.parse_object({"value": value})).value
    except (ArgumentError, TypeError) as error:
        raise ValueError(one_line(error)) from error


@cache
def _parser(kind: Any) -> Any:
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--value", type=kind)
    return parser


# --- to plain data, and messages ---


def plain(value: Any) -> Any:
    """Return a value as plain data for JSON.

    Fields that a dataclass lists in `added` are omitted if they have their default.

    Raises:
        ConfigError: If a value cannot be expressed as plain data.
    """
    if is_dataclass(value) and not isinstance(value, type):
        added = getattr(value, "added", ())
        field_values = {}
        for field in fields(value):
            field_value = getattr(value, field.name)
            if field.name not in added or field_value != field.default:
                field_values[field.name] = field_value
        value = field_values
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, PurePath):
        return str(value)
    if value is None or isinstance(value, int | float | str):
        return value
    raise ConfigError(
        f"Expected plain data (numbers, text, lists, mappings), got {value!r}."
    )


def hint(name: str, names: Iterable[str], prefix: str = "") -> str:
    """Return a sentence that suggests the most similar name; empty if none is similar.

    The sentence begins with a space.
    """
    similar = difflib.get_close_matches(name, list(names), n=1)
    return f" Did you mean {prefix + similar[0]!r}?" if similar else ""


def check_known(what: str, value: Any, names: Iterable[str]) -> None:
    """Check that a value is among names; the message suggests a similar name.

    Args:
        what: name of the value in the message.
        value: value to check.
        names: valid values.

    Raises:
        ConfigError: If the value is not among `names`.
    """
    names = list(names)
    if value not in names:
        raise ConfigError(
            f"Expected {what} among {', '.join(names)}, got "
            f"{value!r}.{hint(str(value), names)}"
        )


def one_line(error: BaseException) -> str:
    """Return the type and text of an exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def fault(error: BaseException) -> str:
    """Return the error of a part in one line; a `BenchnavError` without its type."""
    if isinstance(error, BenchnavError):
        return " ".join(str(error).split())
    return one_line(error)
