"""Parts and sweeps of a suite: where it gives several values for one, it means each of
them.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import torch

from benchnav.core import hub, registry
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.registry import Part
from benchnav.core.settings import changed, of, read
from benchnav.eval.experiment.suite import MAX_CONDITIONS
from benchnav.models.base import is_family
from benchnav.models.predictor import ModelPart, no_model

_Chosen = dict[tuple[str, ...], Any]  # values by where they stand


def part_of(kind: str, about: Mapping[str, Any], label: str) -> Part:
    """Return the part that `part` and `options` describe."""
    part_class = ModelPart if kind == "model" else Part
    return part_class(
        kind=kind, part=about["part"], label=label, options=about["options"]
    )


def read_parts(kind: str, given: Any) -> list[Part]:
    """Read what a suite lists as one part: several parts where options are given lists
    of values.

    Args:
        kind: one of `registry.KINDS`.
        given: in any form that `registry.read_part` reads.

    Raises:
        ConfigError: If there is no such part or option, or the part rejects its
            options.
    """
    part = registry.read_part(kind, given)
    if kind == "model":
        model = ModelPart(**vars(part))
        if folder := model.folder:
            is_named = part.label not in (part.part, part.part.rpartition(":")[2])
            label = (
                part.part.rpartition("/")[2]
                if hub.is_address(part.part)
                else folder.name
            )
            return [model if is_named else replace(model, label=label)]
        if is_family(model.found.target):
            raise no_model(model)
    completed = [registry.complete(kind, one) for one in each_part(kind, part)]
    parts = [part_of(kind, vars(one), one.label) for one in completed]
    for one in parts:
        if kind == "risk" and one.found.shipped:
            # Lets it reject its options on one cell, also where no condition uses it.
            cell = torch.full((1, 1, 1, 1), 0.5)
            one.object(TraversabilityMixture(torch.ones_like(cell), cell, cell, (0,)))
        elif kind in ("sensor", "ground", "belief"):
            _ = one.object  # rejects its options
    return parts


def each_part(kind: str, part: Part) -> list[Part]:
    """Gives a part for each combination of values where an option is given a list of
    them.

    A list that the option itself takes, such as a pair of bounds, is one value. Each
    part is labelled by its
    values: `cvar:0.9` for the first option, which stands behind a colon, `astar_dwa
    lookahead_m=4` for others.

    Args:
        kind: of the part, as in `registry.KINDS`.
        part: with options that may hold lists.

    Returns:
        The part itself where nothing is swept.
    """
    known = registry.options_of(kind, registry.find(kind, part.part).target)
    first = next(iter(known), "")
    swept = {
        name: value
        for name, value in part.options.items()
        if name in known and not _taken(kind, part.part, name, known[name], value)
    }
    parts = []
    for chosen in _choices(swept):
        named = {".".join(path): value for path, value in chosen.items()}
        label = registry.label_of(part.label, named, first)
        parts.append(replace(part, label=label, options=_with(part.options, chosen)))
    return parts


def each_mapping(given: Any) -> list[Any]:
    """Gives a mapping for each combination of values where one is a list, at any depth;
    anything else as it is.
    """
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
    if math.prod(counts) > MAX_CONDITIONS:
        product_of = " × ".join(map(str, counts))
        raise ConfigError(
            f"Expected at most {MAX_CONDITIONS:,} settings, got a product of "
            f"{product_of} values. List fewer."
        )


def _taken(kind: str, source: str, name: str, option: Any, value: Any) -> bool:
    try:
        read(option.kind, value, of(f"{kind} {source!r}"), name)
    except ConfigError:
        return False
    return True


def _lists(
    value: Any, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], list[Any]]]:
    """Lists in a value, at any depth, each with where it stands."""
    if isinstance(value, list | tuple):
        if not value:
            raise ConfigError(
                f"Expected one or more values of `{'.'.join(path)}`, got none."
            )
        yield path, list(value)
    elif isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _lists(inner, (*path, str(name)))


def _with(options: Mapping[str, Any], chosen: _Chosen) -> dict[str, Any]:
    made = dict(options)
    for path, value in chosen.items():
        made = changed(made, path, value)
    return made
