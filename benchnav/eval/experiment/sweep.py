"""Sweeps of a suite: an option with a list of values yields one part for each value."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import torch

from benchnav.core import hub, registry
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.registry import Part
from benchnav.core.settings import changed, of, read
from benchnav.eval.experiment.suite import MAX_CONDITIONS
from benchnav.models.base import is_family
from benchnav.models.predictor import ModelPart, no_checkpoint_error

_Chosen = dict[tuple[str, ...], Any]  # values by their path in a mapping


def part_of(kind: str, spec: Mapping[str, Any], label: str) -> Part:
    """Return a part from its description.

    Args:
        kind: one of `registry.KINDS`.
        spec: mapping with `part` and `options`.
        label: label of the part.
    """
    part_class = ModelPart if kind == "model" else Part
    return part_class(
        kind=kind, part=spec["part"], label=label, options=spec["options"]
    )


def read_parts(kind: str, spec: Any) -> list[Part]:
    """Read one entry of a suite; an option with a list of values yields several parts.

    Args:
        kind: one of `registry.KINDS`.
        spec: entry in any form that `registry.read_part` reads.

    Raises:
        ConfigError: If the part or an option does not exist, or the part rejects its
            options.
    """
    part = registry.read_part(kind, spec)
    if kind == "model":
        model = ModelPart(**vars(part))
        if model.folder:
            return [_with_folder_label(model, model.folder)]
        if is_family(model.found.target):
            raise no_checkpoint_error(model)
    parts = []
    for variant in each_part(kind, part):
        completed = registry.complete(kind, variant)
        parts.append(part_of(kind, vars(completed), completed.label))
    for part in parts:
        _check_options(kind, part)
    return parts


def _with_folder_label(model: ModelPart, folder: Path) -> ModelPart:
    """Label a checkpoint by its address or folder, unless the suite gives a label."""
    if model.label not in (model.part, model.part.rpartition(":")[2]):
        return model
    if hub.is_address(model.part):
        return replace(model, label=model.part.rpartition("/")[2])
    return replace(model, label=folder.name)


def _check_options(kind: str, part: Part) -> None:
    """Create or call a part so that it rejects invalid options, even if it is unused."""
    if kind == "risk" and part.found.shipped:
        cell = torch.full((1, 1, 1, 1), 0.5)
        weight = torch.ones_like(cell)
        part.object(TraversabilityMixture(weight, cell, cell, (0,)))
    elif kind in ("sensor", "ground", "belief"):
        _ = part.object


def each_part(kind: str, part: Part) -> list[Part]:
    """Return a part for each combination of swept option values.

    A list that the option itself accepts, such as a pair of bounds, is one value. The
    label of each part contains its values: `cvar:0.9` for the first option,
    `astar_dwa lookahead_m=4` for other options.

    Args:
        kind: kind of the part, one of `registry.KINDS`.
        part: part whose options may contain lists.

    Returns:
        Parts in the order of the product; only the given part if no option is swept.
    """
    options = registry.options_of(kind, registry.find(kind, part.part).target)
    first = next(iter(options), "")
    swept = {}
    for name, value in part.options.items():
        if name not in options:
            continue
        if not _accepts(kind, part.part, name, options[name], value):
            swept[name] = value
    parts = []
    for chosen in _choices(swept):
        named = {".".join(path): value for path, value in chosen.items()}
        label = registry.label_of(part.label, named, first)
        chosen_options = _with(part.options, chosen)
        parts.append(replace(part, label=label, options=chosen_options))
    return parts


def each_mapping(value: Any) -> list[Any]:
    """Return a mapping for each combination of listed values, at any depth."""
    if not isinstance(value, Mapping):
        return [value]
    return [_with(value, chosen) for chosen in _choices(value)]


def _choices(mapping: Mapping[str, Any]) -> Iterator[_Chosen]:
    """Yield each combination of values of the lists in a mapping, by path."""
    lists = dict(_lists(mapping, ()))
    check_count(map(len, lists.values()))
    for values in product(*lists.values()):
        yield dict(zip(lists, values, strict=True))


def check_count(counts: Iterable[int]) -> None:
    """Reject more than `MAX_CONDITIONS` combinations before they are formed.

    Args:
        counts: number of values in each list of the product.

    Raises:
        ConfigError: If the lists have more combinations.
    """
    counts = [count for count in counts if count > 1]
    if math.prod(counts) > MAX_CONDITIONS:
        factors = " × ".join(map(str, counts))
        raise ConfigError(
            f"Expected at most {MAX_CONDITIONS:,} combinations of values, got "
            f"{factors}. List fewer values."
        )


def _accepts(kind: str, source: str, name: str, option: Any, value: Any) -> bool:
    """Return whether an option accepts a value unswept, such as a pair of bounds."""
    try:
        read(option.kind, value, of(f"{kind} {source!r}"), name)
    except ConfigError:
        return False
    return True


def _lists(
    value: Any, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], list[Any]]]:
    """Yield the path and the values of each list in a value, at any depth."""
    if isinstance(value, list | tuple):
        if not value:
            raise ConfigError(
                f"Expected one or more values of `{'.'.join(path)}`, got an empty "
                "list. Leave it out for the default."
            )
        yield path, list(value)
    elif isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _lists(inner, (*path, str(name)))


def _with(options: Mapping[str, Any], chosen: _Chosen) -> dict[str, Any]:
    updated = dict(options)
    for path, value in chosen.items():
        updated = changed(updated, path, value)
    return updated
