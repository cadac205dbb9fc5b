"""Finds the sweeps of a run: conditions that are equal in all but one number, which takes three values or more."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from benchnav.models.quality.series import find_series

SEVERITY = "severity"
LEAST_VALUES = 3


@dataclass(frozen=True, kw_only=True)
class Line:
    """Conditions of one sweep that differ in its number alone.

    Args:
        values: of the number, ascending.
        conditions: ids, one a value.
        rest: all else that the conditions are, by name with dots.
    """

    values: tuple[float, ...]
    conditions: tuple[str, ...]
    rest: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """All lines over one number.

    Args:
        number: its name with dots, such as `risk.options.level`; `severity` for that of scenarios.
        lines: in the order of the run.
    """

    number: str
    lines: tuple[Line, ...]


def flatten(value: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Names every entry of nested mappings by its path with dots; a list is an entry."""
    flat: dict[str, Any] = {}
    for name, inner in value.items():
        path = f"{before}{name}"
        flat |= flatten(inner, f"{path}.") if isinstance(inner, Mapping) else {path: inner}
    return flat


def find_sweeps(conditions: Mapping[str, Mapping[str, Any]]) -> list[Sweep]:
    """Finds the sweeps of a run.

    A number that others follow, such as two that were changed together, makes no sweep.

    Args:
        conditions: by id, with `value`, as `run.json` holds them; those of format version 1 say too little of
            themselves and make none.

    Returns:
        By name of the number.
    """
    flat = {
        condition: flatten(about["value"])
        for condition, about in conditions.items()
        if "split" in about["value"]
    }
    numbers = sorted({name for one in flat.values() for name, value in one.items() if _is_number(value)})
    sweeps = [Sweep(number=name, lines=tuple(_lines(_along(flat, name)))) for name in numbers]
    sweeps.append(Sweep(number=SEVERITY, lines=tuple(_lines(_along_severity(flat)))))
    return [sweep for sweep in sweeps if sweep.lines]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


Found = Iterator[tuple[str, float, dict[str, Any]]]


def _along(flat: Mapping[str, Mapping[str, Any]], name: str) -> Found:
    """Conditions with their value of a number, and all else."""
    for condition, one in flat.items():
        if _is_number(one.get(name)):
            yield condition, float(one[name]), {key: value for key, value in one.items() if key != name}


def _along_severity(flat: Mapping[str, Mapping[str, Any]]) -> Found:
    for scenario, pairs in find_series(dict.fromkeys(one["split"] for one in flat.values())).items():
        severities = {split: severity for severity, split in pairs}
        for condition, one in flat.items():
            if one["split"] in severities:
                yield condition, severities[one["split"]], {**one, "split": scenario}


def _lines(found: Found) -> Iterator[Line]:
    table = pd.DataFrame(
        [(condition, value, repr(sorted(rest.items())), rest) for condition, value, rest in found]
    )
    if table.empty:
        return
    table.columns = pd.Index(["condition", "value", "key", "rest"])
    for _, group in table.groupby("key", sort=False):
        if group["value"].nunique() >= LEAST_VALUES:
            ordered = group.sort_values("value", kind="stable")
            yield Line(
                values=tuple(ordered["value"]),
                conditions=tuple(ordered["condition"]),
                rest=group["rest"].iloc[0],
            )
