"""Types in annotations: members of unions, and names of types in messages."""

from dataclasses import is_dataclass
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

_WORDS = {
    int: "a whole number",
    float: "a number",
    str: "text",
    bool: "true or false",
    NoneType: "null",
    Any: "anything",
}


def dataclass_in(kind: Any) -> Any:
    """Return the dataclass in a type such as `Config | None`; None if it has none."""
    for member in members_of(kind):
        if isinstance(member, type) and is_dataclass(member):
            return member
    return None


def members_of(kind: Any) -> tuple[Any, ...]:
    """Return the types of a union, the values of a literal, or the type itself."""
    if get_origin(kind) in (Union, UnionType):
        return tuple(inner for member in get_args(kind) for inner in members_of(member))
    return get_args(kind) if get_origin(kind) is Literal else (kind,)


def in_words(kind: Any) -> str:
    """Return a type in plain words, for messages."""
    members = get_args(kind)
    origin = get_origin(kind)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(in_words, members)))
    if origin is Literal:
        return " or ".join(map(repr, members))
    if origin in (list, tuple):
        inner = [in_words(member) for member in members if member is not ...]
        if len(inner) == 1:
            return f"a list, each {inner[0]}"
        return f"a list [{', '.join(inner)}]"
    if origin is dict or dataclass_in(kind):
        return "a mapping"
    return _WORDS.get(kind, getattr(kind, "__name__", str(kind)))
