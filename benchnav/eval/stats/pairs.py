"""Pairs of conditions that differ in one part, on the same maps and draws of λ."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, combinations
from typing import Any

import pandas as pd

from benchnav.core.errors import ConfigError
from benchnav.core.settings import check_known
from benchnav.eval.experiment.condition import (
    KNOWLEDGE,
    LABELS,
    NOT_USED,
    SPLIT_PROPERTIES,
    differences,
)
from benchnav.eval.experiment.unit import DRAW

# Columns in which the conditions of a pair may differ, with their keys in a condition's
# value. `data` and `scenario` are excluded, since they determine the maps.
_PARTS = ("risk", "planner", "model", "objective", "robot", *KNOWLEDGE)
_KEYS: Mapping[str, tuple[str, ...]] = {
    **{name: (name,) for name in _PARTS},
    "world": ("world", "rules"),
    "run": (),
}
# Columns of episodes that a pair has for both conditions.
_MEASURES = (
    "success",
    "total_time_s",
    "time_budget_s",
    "score",
    "traversability",
    "path_length_m",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """A condition with its episodes, from one or several runs.

    Args:
        labels: labels in tables by column, including `run`, which is `NOT_USED` unless
            several runs contain the condition.
        value: all settings that affect the rows, as in `run.json`.
        maps: digests of the maps, in the order of maps.
        episodes: rows of the condition, with the time budget T in the column
            `time_budget_s`.
        code: code of the rows by name of the run, as in `Origin.code`.
        map_properties: digest of the `SPLIT_PROPERTIES` of the maps; empty if the run
            does not contain it.
    """

    labels: Mapping[str, str]
    value: Mapping[str, Any]
    maps: Sequence[str]
    episodes: pd.DataFrame
    code: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    map_properties: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Two conditions, and their episodes side by side.

    Args:
        one: label of the first condition.
        other: label of the second condition, with which the first is compared.
        shared: labels of both conditions by column; if only one condition uses a part,
            the label of this condition.
        episodes: common episodes, as `side_by_side` returns them. Maps may have
            different numbers of episodes.
        members: the first and the second condition.
    """

    one: str
    other: str
    shared: Mapping[str, str]
    episodes: pd.DataFrame
    members: tuple[Compared, ...] = ()


def find_pairs(
    conditions: Sequence[Compared], by: str = "", against: str = ""
) -> list[Pair]:
    """Pair conditions whose values differ only in one part.

    A part that one of the conditions does not use, such as the risk setting of a blind
    planner, is ignored.

    Args:
        conditions: conditions of one or several runs; each condition occurs once unless
            runs are compared with each other.
        by: column that differs; if empty, see `by_what`.
        against: label with which all other conditions are paired; if empty, all pairs
            are formed.

    Returns:
        Pairs, grouped by their common labels.

    Raises:
        ConfigError: If there is nothing to compare, or conditions cannot be paired.
    """
    by = by_what(conditions, by, against)
    used = [c.labels[by] for c in conditions if c.labels[by] != NOT_USED]
    values = list(dict.fromkeys(used))
    if against:
        check_known("`against`", against, values)
    pairs = [_pair(a, b, by) for a, b in matches(conditions, by, against)]
    if not pairs:
        listed = ", ".join(values) or NOT_USED
        raise ConfigError(
            f"Expected two or more conditions that differ only in their {by}, got "
            f"conditions with {by} {listed}.{_other_differences(conditions, by)}"
        )
    families: dict[tuple[str, ...], list[Pair]] = defaultdict(list)
    for pair in pairs:
        families[tuple(pair.shared.values())].append(pair)
    return list(chain.from_iterable(families.values()))


def matches(
    conditions: Sequence[Compared], by: str, against: str = ""
) -> Iterator[tuple[Compared, Compared]]:
    """Yield the two conditions of each pair of `find_pairs`.

    Args:
        conditions: as in `find_pairs`.
        by: column from `by_what`.
        against: as in `find_pairs`.
    """
    for a, b in combinations(conditions, 2):
        labels = (a.labels[by], b.labels[by])
        is_selected = not against or against in labels
        if not is_selected or not _differ_in(a, b, by):
            continue
        # A condition with the label `against` is the second of a pair.
        if against and b.labels[by] == against:
            yield a, b
        else:
            yield b, a


def by_what(conditions: Sequence[Compared], by: str = "", against: str = "") -> str:
    """Return the column by which conditions are compared, a key of `_KEYS`.

    Args:
        conditions: conditions that are compared.
        by: requested column. If empty, the column with the label `against`; without
            `against`, `run` if runs have common conditions, otherwise `risk`.
        against: label of a condition; may be empty.

    Raises:
        ConfigError: If `by` is no key of `_KEYS`, or `against` is a label of no column
            or of several columns.
    """
    if by:
        check_known("`by` (data and scenario determine the maps)", by, _KEYS)
        return by
    if not against:
        has_runs = any(c.labels["run"] != NOT_USED for c in conditions)
        return "run" if has_runs else "risk"
    columns_of: dict[str, dict[str, None]] = defaultdict(dict)
    for condition in conditions:
        for name in _KEYS:
            columns_of[condition.labels[name]][name] = None
    columns_of.pop(NOT_USED, None)
    check_known("`against`", against, sorted(columns_of))
    columns = list(columns_of[against])
    if len(columns) > 1:
        raise ConfigError(
            f"Expected `against` to be a label of one column, got {against!r}, which "
            f"is a label of {' and of '.join(columns)}. Pass --by "
            f"{' or --by '.join(columns)}."
        )
    return columns[0]


def check_one_value_each(conditions: Iterable[Compared]) -> None:
    """Reject two values with the same label, which readers could not distinguish.

    Raises:
        ConfigError: If two values have the same label.
    """
    values: dict[tuple[str, str], tuple[dict[str, Any], Compared]] = {}
    for condition in conditions:
        for name, keys in _KEYS.items():
            value = {key: condition.value.get(key) for key in keys}
            label = condition.labels[name]
            earlier, first = values.setdefault((name, label), (value, condition))
            if earlier != value and label != NOT_USED:
                runs = " and ".join(dict.fromkeys([*first.code, *condition.code]))
                raise ConfigError(
                    f"Expected one {name} for each label, got two with the label "
                    f"{label!r} in {runs}: {_in_words(earlier, value)}. Leave one of "
                    "the runs out, or run one again with another label."
                )


def _in_words(a: Any, b: Any) -> str:
    """Describe differences of plain data, such as `options.level 0.5 and 0.9`."""
    words = [f"{name} {old} and {new}" for name, old, new in differences(a, b)]
    return ", ".join(words)


def _other_differences(conditions: Sequence[Compared], by: str) -> str:
    """Describe differences of conditions that prevent pairs by a column."""
    fields: dict[str, dict[str, Any]] = {}
    for condition in conditions:
        field_ = drawn_field(condition.value["world"])
        fields[repr(field_)] = field_
    if by == "world" and len(fields) > 1:
        first, second, *_ = fields.values()
        return f" Their worlds draw different λ: {_in_words(first, second)}."
    differing: dict[str, set[str]] = {}
    for name in _KEYS:
        labels = {condition.labels[name] for condition in conditions} - {NOT_USED}
        if name != by and len(labels) > 1:
            differing[name] = labels
    if not differing:
        return ""
    words = []
    for name, labels in differing.items():
        words.append(f"{name} ({', '.join(sorted(labels))})")
    first_name = next(iter(differing))
    return f" They differ in {' and '.join(words)}. Try `--by {first_name}`."


def _differ_in(a: Compared, b: Compared, by: str) -> bool:
    """Return whether two conditions with the same λ differ only in one part.

    Both conditions must use the part.
    """
    if by == "run":
        return a.value == b.value and a.labels["run"] != b.labels["run"]
    unused = [name for name in _KEYS if NOT_USED in (a.labels[name], b.labels[name])]
    if by in unused:
        return False
    keys = {*a.value, *b.value}
    differing = {key for key in keys if a.value.get(key) != b.value.get(key)}
    by_keys = set(_KEYS[by])
    is_only_difference = differing - set(unused) <= by_keys
    if not is_only_difference or not differing & by_keys:
        return False
    return drawn_field(a.value["world"]) == drawn_field(b.value["world"])


def drawn_field(world: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a world that determine the drawn λ.

    If λ is frozen, they include the threshold of immobilising terrain and the clearance
    of accepted draws.

    Args:
        world: world of a condition, as in `run.json`.
    """
    if world["noise"] != "frozen":
        return {"noise": world["noise"]}
    immobile = world.get("immobile") or {}
    return {
        "noise": "frozen",
        "correlation_m": world.get("correlation_m"),
        "kernel": world.get("kernel"),
        "immobile.below": immobile.get("below"),
        "clearance_m": world.get("clearance_m"),
    }


def _pair(first: Compared, second: Compared, by: str) -> Pair:
    names = f"{first.labels[by]!r} and {second.labels[by]!r}"
    check_maps(first, second, names)
    paired = side_by_side(first.episodes, second.episodes, _MEASURES)
    if paired.empty:
        raise ConfigError(
            f"Expected conditions with common episodes, got {names} with "
            f"{_draws(first)} and {_draws(second)}. Run them with the same seeds."
        )
    shared = {}
    for name in (*LABELS, "run"):
        if name == by:
            continue
        is_used = first.labels[name] != NOT_USED
        shared[name] = first.labels[name] if is_used else second.labels[name]
    return Pair(
        one=first.labels[by],
        other=second.labels[by],
        shared=shared,
        episodes=paired,
        members=(first, second),
    )


def side_by_side(
    first: pd.DataFrame, second: pd.DataFrame, measures: Sequence[str]
) -> pd.DataFrame:
    """Return the common episodes of two conditions, one row per episode.

    Args:
        first: rows of the first condition.
        second: rows of the second condition.
        measures: columns of both conditions.

    Returns:
        `group`, the statistical unit; the columns `DRAW`; the measures of the first
        condition; and the measures of the second, with the suffix `_other`.
    """
    columns = [*DRAW, *measures]
    first_columns = first[["group", *columns]]
    return first_columns.merge(second[columns], on=DRAW, suffixes=("", "_other"))


def on_common_draws(conditions: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Return the common episodes of all conditions, in the same order.

    Args:
        conditions: rows of each condition, by id.
    """
    draws = []
    for rows in conditions.values():
        draws.append(set(rows[DRAW].itertuples(index=False, name=None)))
    common_draws = sorted(set.intersection(*draws))
    common = pd.DataFrame(common_draws, columns=DRAW, dtype=int)
    return {
        condition: common.merge(rows, on=DRAW) for condition, rows in conditions.items()
    }


def check_maps(first: Compared, second: Compared, names: str) -> None:
    """Check that two conditions have the same maps, properties and groups of maps.

    Args:
        first: first condition.
        second: second condition.
        names: names of both conditions, for the message.

    Raises:
        ConfigError: If maps with the same index have different digests, or the
            properties or the groups of the maps differ.
    """
    common = min(len(first.maps), len(second.maps))
    if list(first.maps[:common]) != list(second.maps[:common]):
        raise ConfigError(
            f"Expected conditions on the same maps, got {names}, whose maps differ. "
            "Run them on the same dataset."
        )
    first_groups = first.episodes.groupby("map")["group"].first()
    second_groups = second.episodes.groupby("map")["group"].first()
    common_maps = first_groups.index.intersection(second_groups.index)
    differing = []
    has_properties = bool(first.map_properties and second.map_properties)
    if has_properties and first.map_properties != second.map_properties:
        differing.append(SPLIT_PROPERTIES)
    if not first_groups[common_maps].equals(second_groups[common_maps]):
        differing.append("groups of maps")
    if differing:
        split = f"of {first.value['data']} {first.value['split']}"
        words = ", ".join(f"{name} {split}" for name in differing)
        raise ConfigError(
            f"Expected conditions on maps with the same properties, got {names}, which "
            f"differ in {words}. Run them on the same dataset."
        )


def _draws(condition: Compared) -> str:
    """Return the seeds and realisations of a condition in words."""
    words = []
    for name in ("seed", "realisation"):
        values = sorted(condition.episodes[name].unique())
        words.append(f"{name}s {', '.join(map(str, values))}")
    return ", ".join(words)
