"""Sweeps: where a suite gives several values for one, it means each of them."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from typing import Any

from benchnav.core import registry
from benchnav.core.errors import ConfigError, expect
from benchnav.core.registry import Part
from benchnav.core.settings import changed, of, read
from benchnav.eval.experiment.suite import MAX_CONDITIONS

_Chosen = dict[tuple[str, ...], Any]  # values by where they stand


def each_part(kind: str, part: Part) -> list[Part]:
    """Gives a part for each combination of values where an option is given a list of them.

    A list that the option itself takes, such as a pair of bounds, is one value. Each part is labelled by its
    values: `cvar:0.9` for the first option, which stands behind a colon, `astar_dwa lookahead_m=4` for others.

    Args:
        kind: of the part, as in `registry.KINDS`.
        part: with options that may hold lists.

    Returns:
        The part itself where nothing is swept.
    """
    known = registry.options_of(kind, registry.find(kind, part.part).target)
    swept = {
        name: value
        for name, value in part.options.items()
        if name in known and not _taken(kind, part.part, name, known[name], value)
    }
    first = next(iter(known), "")
    return [
        replace(part, label=_label(part.label, chosen, first), options=_with(part.options, chosen))
        for chosen in _choices(swept)
    ]


def each_mapping(given: Any) -> list[Any]:
    """Gives a mapping for each combination of values where one is a list, at any depth; anything else as it is."""
    if not isinstance(given, Mapping):
        return [given]
    return [_with(given, chosen) for chosen in _choices(given)]


def _choices(given: Mapping[str, Any]) -> Iterator[_Chosen]:
    """A value for each list in a mapping, by where it stands, in all combinations."""
    lists = dict(_lists(given, ()))
    check_count(map(len, lists.values()))
    for values in product(*lists.values()):
        yield dict(zip(lists, values, strict=True))


def check_count(counts: Iterable[int]) -> None:
    """Refuse a product of more than `MAX_CONDITIONS` settings before it is built.

    Args:
        counts: of values, in each list of the product.

    Raises:
        ConfigError: If there are more.
    """
    counts = [count for count in counts if count > 1]
    expect(
        math.prod(counts) <= MAX_CONDITIONS,
        f"at most {MAX_CONDITIONS:,} settings, got a product of {' × '.join(map(str, counts))} values. List fewer.",
    )


def _taken(kind: str, source: str, name: str, option: Any, value: Any) -> bool:
    try:
        read(option.kind, value, of(f"{kind} {source!r}"), name)
    except ConfigError:
        return False
    return True


def _lists(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], list[Any]]]:
    """Lists in a value, at any depth, each with where it stands."""
    if isinstance(value, list | tuple):
        if not value:
            raise ConfigError(f"Expected one or more values of `{'.'.join(path)}`, got none.")
        yield path, list(value)
    elif isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _lists(inner, (*path, str(name)))


def _with(options: Mapping[str, Any], chosen: _Chosen) -> dict[str, Any]:
    made = dict(options)
    for path, value in chosen.items():
        made = changed(made, path, value)
    return made


def _label(label: str, chosen: _Chosen, first: str) -> str:
    if list(chosen) == [(first,)]:
        return f"{label}:{_text(chosen[(first,)])}"
    return " ".join([label, *(f"{'.'.join(path)}={_text(value)}" for path, value in chosen.items())])


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
