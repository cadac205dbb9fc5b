"""Settings by type: plain data of YAML, JSON and command lines becomes dataclasses and
options of parts, and back.

The options of a class or function are its keyword parameters; where its one parameter
is a dataclass named `config`, the fields of that are. A value is read by its annotated
type: a dataclass here, key by key, so that a message can say which key is wrong;
anything else by jsonargparse.
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
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from benchnav.core.errors import BenchnavError, ConfigError, out_of_memory
from benchnav.core.yaml_text import MAX_DEPTH, check_yaml

NO_DEFAULT = inspect.Parameter.empty

Naming = Callable[[str], str]  # what users call a key; of an empty one, the whole

_UNNAMED = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
_WORDS = {
    int: "a whole number",
    float: "a number",
    str: "text",
    bool: "true or false",
    NoneType: "null",
    Any: "anything",
}


@dataclass(frozen=True, kw_only=True)
class Option:
    """One option.

    Args:
        kind: its type, as annotated; `Any` where it is not.
        default: `NO_DEFAULT` where it has to be given.
    """

    kind: Any
    default: Any


# --- options of classes and functions ---


def list_options(
    target: Callable[..., Any], skipped: Iterable[str] = ()
) -> dict[str, Option]:
    """Lists options by name, in order.

    Args:
        target: a class, or a function.
        skipped: names of parameters that are no options.
    """
    target = config_class(target, skipped) or target
    types = _types(target)
    made: dict[str, Any] = (
        {f.name: f.default_factory for f in fields(target)}
        if is_dataclass(target)
        else {}
    )
    return {
        name: Option(
            kind=types.get(name, Any),
            default=parameter.default
            if made.get(name, MISSING) is MISSING
            else made[name](),
        )
        for name, parameter in parameters(target).items()
        if name not in set(skipped)
    }


def config_class(target: Callable[..., Any], skipped: Iterable[str] = ()) -> Any:
    """The dataclass of a sole parameter `config`; None where there is no such
    parameter.
    """
    if [name for name in parameters(target) if name not in set(skipped)] != ["config"]:
        return None
    return dataclass_in(_types(target).get("config"))


def parameters(target: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Parameters that have names of their own; a class without a constructor has none."""
    if inspect.isclass(target) and target.__init__ is object.__init__:
        return {}
    return {
        n: p
        for n, p in inspect.signature(target).parameters.items()
        if p.kind not in _UNNAMED
    }


def _types(target: Any) -> dict[str, Any]:
    """Types of parameters; one that cannot be told, such as a name imported for type
    checkers, is left out.
    """
    if inspect.isclass(target) and not is_dataclass(target):
        target = target.__init__
    try:
        return get_type_hints(target)
    except Exception:
        names = getattr(target, "__globals__", None) or vars(
            sys.modules.get(target.__module__, target)
        )
        found: dict[str, Any] = {}
        for name, annotation in inspect.get_annotations(target).items():
            with suppress(Exception):
                found |= get_type_hints(
                    SimpleNamespace(__annotations__={name: annotation}), names
                )
        return found


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
        raise out_of_memory(error) or ConfigError(
            f"{what} could not be made: {one_line(error)}"
        ) from error


# --- from plain data ---


def of(owner: str) -> Naming:
    """Names keys as those of an owner, such as "planner 'mppi'"."""
    return lambda key: f"`{key}` of {owner}" if key else owner


def read(
    kind: Any, value: Any, name: Naming, key: str = "", now: Any = NO_DEFAULT
) -> Any:
    """Gives a value of a type.

    Args:
        kind: the type, as annotated.
        value: plain data, or a value of the type; text is read as the command line
            reads it.
        name: what users call a key.
        key: where it stands, with dots; empty for the whole.
        now: a value that this one takes the place of. Of a dataclass, what is not given
            stays as it is there.

    Raises:
        ConfigError: a key is unknown or missing, or a value is of another type or
            refused by its dataclass.
    """
    _check_size(value, name(key))
    if (
        kind is Any
        or (isinstance(kind, type) and type(value) is kind)
        or (value is None and now is None)
    ):
        return value
    config, origin, members = dataclass_in(kind), get_origin(kind), get_args(kind)
    if config and isinstance(value, Mapping):
        base = now if isinstance(now, config) else None
        before = (
            {f.name: getattr(base, f.name) for f in fields(base)}
            if base is not None
            else None
        )
        given = read_options(list_options(config), value, name, key, before)
        return call(name(key), partial(replace, base) if base else config, given)
    if origin is dict and dataclass_in(members[1]) and isinstance(value, Mapping):
        if not all(isinstance(inner, str) for inner in value):
            raise ConfigError(
                f"Expected names in {name(key)}, got {list(value)}. Quote numbers."
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
        check_yaml(data)  # which the parser reads without a look at keys and nesting
    try:
        parsed = _parsed(kind, data)
    except ValueError as error:
        got = "null" if value is None else repr(value)
        near = hint(
            str(value),
            [member for member in members_of(kind) if isinstance(member, str)],
        )
        raise ConfigError(
            f"Expected {name(key)} as {in_words(kind)}, got {got}.{near}"
        ) from error
    _check_size(parsed, name(key))
    return parsed


def _check_size(value: Any, what: str) -> None:
    """Refuse whole numbers that no array and no generator takes."""
    if type(value) is int and abs(value) >= 2**64:
        raise ConfigError(
            f"Expected {what} as a whole number of at most 64 bits, got one of "
            f"{value.bit_length()}."
        )


def read_options(
    known: Mapping[str, Option],
    given: Mapping[str, Any],
    name: Naming,
    key: str = "",
    now: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Gives options of their types, by name.

    Args:
        known: what there is.
        given: plain data by option.
        name: what users call a key.
        key: where they stand, with dots; empty for the whole.
        now: what is not given, by name; without it an option that has no default is to
            be given.

    Raises:
        ConfigError: as of `read`.
    """
    inner = f"{key}." if key else ""
    for option in map(str, given):
        if option not in known:
            among = f"among {', '.join(known)}" if known else "none: it has none"
            raise ConfigError(
                f"Expected keys of {name(key)} {among}, got "
                f"{option!r}.{hint(option, known)}"
            )
    for option, about in known.items():
        if about.default is NO_DEFAULT and option not in given and now is None:
            raise ConfigError(
                f"Expected {name(inner + option)} as {in_words(about.kind)}, got none."
            )
    before = {option: about.default for option, about in known.items()} | dict(
        now or {}
    )
    return {
        option: read(known[option].kind, value, name, inner + option, before[option])
        for option, value in given.items()
    }


def changed(data: Any, path: Sequence[str], value: Any) -> Any:
    """A copy of plain data with one value set.

    Args:
        data: mappings, and lists whose items go by their `name`, as of terrain classes.
        path: keys that lead to the value; mappings that are not there are made.
        value: plain data.

    Raises:
        ConfigError: on the way is something that has no keys.
    """
    if len(path) > MAX_DEPTH:
        raise ConfigError(
            f"Expected at most {MAX_DEPTH} keys with dots between, got {len(path)}."
        )
    if not path:
        return value
    key, rest = path[0], path[1:]
    if isinstance(data, list):
        names = _names(data)
        if key not in names:
            raise ConfigError(
                f"Expected a name among {', '.join(names)}, got "
                f"{key!r}.{hint(key, names)}"
            )
        return [
            changed(item, rest, value) if n == key else item
            for n, item in zip(names, data, strict=True)
        ]
    if not isinstance(data, Mapping | None):
        raise ConfigError(
            f"Expected a mapping in which {'.'.join(path)!r} can be set, got {data!r}."
        )
    return {**(data or {}), key: changed((data or {}).get(key), rest, value)}


def _names(items: Sequence[Any]) -> list[str]:
    """What items of a list go by: their `name`, or their number."""
    return [
        str(item.get("name", n)) if isinstance(item, Mapping) else str(n)
        for n, item in enumerate(items)
    ]


def _parsed(kind: Any, value: Any) -> Any:
    from jsonargparse import ArgumentError

    try:
        parser = _parser(kind)
        # The parser takes null, and anything but a mapping for a dataclass, for nothing
        # given.
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


# --- to plain data, and to words ---


def plain(value: Any) -> Any:
    """Gives a value as plain data for JSON; fields that a dataclass lists as `added`
    are left out at their default.

    Raises:
        ConfigError: it is something else.
    """
    if is_dataclass(value) and not isinstance(value, type):
        added, every = (
            getattr(value, "added", ()),
            {each.name: each for each in fields(value)},
        )
        given = {name: getattr(value, name) for name in every}
        value = {
            n: own
            for n, own in given.items()
            if n not in added or own != every[n].default
        }
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


def dataclass_in(kind: Any) -> Any:
    """The dataclass that a type is or, as in `Config | None`, holds; None where there
    is none.
    """
    return next(
        (m for m in members_of(kind) if isinstance(m, type) and is_dataclass(m)), None
    )


def members_of(kind: Any) -> tuple[Any, ...]:
    """What a type allows: the types of a union, the values of a literal, or the type
    itself.
    """
    if get_origin(kind) in (Union, UnionType):
        return tuple(inner for member in get_args(kind) for inner in members_of(member))
    return get_args(kind) if get_origin(kind) is Literal else (kind,)


def in_words(kind: Any) -> str:
    """A type as people call it."""
    members, origin = get_args(kind), get_origin(kind)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(in_words, members)))
    if origin is Literal:
        return " or ".join(map(repr, members))
    if origin in (list, tuple):
        inner = [in_words(member) for member in members if member is not ...]
        return (
            f"a list, each {inner[0]}"
            if len(inner) == 1
            else f"a list [{', '.join(inner)}]"
        )
    if origin is dict or dataclass_in(kind):
        return "a mapping"
    return _WORDS.get(kind, getattr(kind, "__name__", str(kind)))


def hint(name: str, known: Iterable[str], prefix: str = "") -> str:
    """Return a sentence with the nearest known name, beginning with a space; empty if
    none is near.
    """
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" Did you mean {prefix + close[0]!r}?" if close else ""


def check_known(what: str, value: Any, known: Iterable[str]) -> None:
    """Refuses what is not among known names, and gives the nearest.

    Args:
        what: what is expected to be known, for the message.
        value: what was given.
        known: the names.

    Raises:
        ConfigError: it is not among them.
    """
    names = list(known)
    if value not in names:
        raise ConfigError(
            f"Expected {what} among {', '.join(names)}, got "
            f"{value!r}.{hint(str(value), names)}"
        )


def one_line(error: BaseException) -> str:
    """An error as one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def fault(error: BaseException) -> str:
    """An error of a part as one line; our own errors speak for themselves."""
    return (
        " ".join(str(error).split())
        if isinstance(error, BenchnavError)
        else one_line(error)
    )
