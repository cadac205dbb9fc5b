"""Pairs of conditions whose values differ in one part, on the same maps and draws."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import pandas as pd

from benchnav.core.errors import ConfigError
from benchnav.core.settings import check_known
from benchnav.eval.experiment.condition import (
    KNOWLEDGE,
    LABELS,
    MEANING,
    NOT_USED,
    differences,
)
from benchnav.eval.experiment.unit import DRAW

# Columns that conditions may differ in, with their keys in a condition's value. Other
# data or scenarios would be other maps.
_KEYS: Mapping[str, tuple[str, ...]] = {
    **{
        name: (name,)
        for name in ("risk", "planner", "model", "objective", "robot", *KNOWLEDGE)
    },
    "world": ("world", "rules"),
    "run": (),
}
# Columns of an episode that pairs have for both sides.
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
    """A condition of one run, or of several that contain identical rows.

    Args:
        labels: labels in tables by column, including `run`, which is `NOT_USED` unless
            two runs contain one condition.
        value: all that affects its rows, as in `run.json`.
        maps: digests of its maps, in the order of maps.
        episodes: its rows, with T of each as `time_budget_s`.
        code: code that computed the rows, by run: names of sources, versions and parts
            with their digests.
        about: digest of the maps' properties `MEANING`; empty if the run lacks it.
    """

    labels: Mapping[str, str]
    value: Mapping[str, Any]
    maps: Sequence[str]
    episodes: pd.DataFrame
    code: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    about: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Two conditions, and their episodes side by side.

    Args:
        one: label of the first condition.
        other: label of the second condition, which the first is compared with.
        shared: labels of both; if one does not use a part, the other's label.
        episodes: common episodes by seed, realisation and map: `success`,
            `total_time_s`, `time_budget_s` and other measures of the first, those of
            the second with `_other`; and `group`, the statistical unit. Maps may have
            different numbers of episodes.
        members: the conditions.
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

    A part that a condition does not use, such as the risk setting of a blind planner,
    equals any other.

    Args:
        conditions: conditions of one run or several, each once unless runs are compared
            with each other.
        by: column that differs, see `by_what`.
        against: label that all others are compared with; if empty, all pairs.

    Returns:
        Pairs, grouped by their common labels.

    Raises:
        ConfigError: If there is nothing to compare, or it cannot be paired.
    """
    by = by_what(conditions, by, against)
    used = [c.labels[by] for c in conditions if c.labels[by] != NOT_USED]
    values = list(dict.fromkeys(used))
    if against:
        check_known("`against`", against, values)
    pairs = [_pair(a, b, by) for a, b in matches(conditions, by, against)]
    if not pairs:
        raise ConfigError(
            f"Expected two conditions or more that differ in their {by} and in "
            f"nothing else, got {by} "
            f"{', '.join(values) or NOT_USED}.{_others(conditions, by)}"
        )
    families = list(dict.fromkeys(tuple(pair.shared.values()) for pair in pairs))
    return sorted(pairs, key=lambda pair: families.index(tuple(pair.shared.values())))


def matches(
    conditions: Sequence[Compared], by: str, against: str = ""
) -> Iterator[tuple[Compared, Compared]]:
    """Yield both conditions of each pair of `find_pairs`.

    Args:
        conditions: as in `find_pairs`.
        by: column from `by_what`.
        against: as in `find_pairs`.
    """
    for a, b in combinations(conditions, 2):
        is_selected = not against or against in (a.labels[by], b.labels[by])
        if is_selected and _differ_in(a, b, by):
            # The later one comes first, unless the earlier is compared with `against`.
            yield (a, b) if against and b.labels[by] == against else (b, a)


def by_what(conditions: Sequence[Compared], by: str = "", against: str = "") -> str:
    """Return the column by which conditions are compared, a key of `_KEYS`.

    Args:
        conditions: the conditions.
        by: requested column. If empty: the column that contains `against`; `run` if
            runs have common conditions; else `risk`.
        against: a label, or empty.

    Raises:
        ConfigError: If `by` is no key, or `against` is in no column or in several.
    """
    if by:
        check_known("`by` (other data or scenarios are other maps)", by, _KEYS)
        return by
    if not against:
        has_runs = any(c.labels["run"] != NOT_USED for c in conditions)
        return "run" if has_runs else "risk"
    labels = [
        (name, condition.labels[name]) for condition in conditions for name in _KEYS
    ]
    check_known(
        "`against`", against, sorted({label for _, label in labels} - {NOT_USED})
    )
    columns = list(dict.fromkeys(name for name, label in labels if label == against))
    if len(columns) > 1:
        raise ConfigError(
            f"Expected `against` to be a label of one kind, got {against!r}, a label "
            f"of {' and of '.join(columns)}. Pass "
            f"--by {' or --by '.join(columns)}."
        )
    return columns[0]


def check_one_value_each(conditions: Iterable[Compared]) -> None:
    """Reject two values under one label, which readers could not distinguish.

    Raises:
        ConfigError: If there are such values.
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
                    f"Expected one {name} under each label, got two that {runs} call "
                    f"{label!r}: "
                    f"{_in_words(earlier, value)}. Leave one of the runs out, or run "
                    "one again under "
                    "another label."
                )


def _in_words(a: Any, b: Any) -> str:
    """Describe differences of plain data, such as `options.level 0.5 and 0.9`."""
    return ", ".join(
        f"{name} {first} and {second}" for name, first, second in differences(a, b)
    )


def _others(conditions: Sequence[Compared], by: str) -> str:
    """Describe the labels or worlds in which the conditions differ."""
    fields: dict[str, dict[str, Any]] = {}
    for condition in conditions:
        field_ = _field(condition)
        fields[repr(field_)] = field_
    if by == "world" and len(fields) > 1:
        first, second, *_ = fields.values()
        return f" λ itself differs between their worlds: {_in_words(first, second)}."
    differing: dict[str, set[str]] = {}
    for name in _KEYS:
        labels = {condition.labels[name] for condition in conditions} - {NOT_USED}
        if name != by and len(labels) > 1:
            differing[name] = labels
    if not differing:
        return ""
    differences_text = " and ".join(
        f"{name} ({', '.join(sorted(labels))})" for name, labels in differing.items()
    )
    return f" They differ in {differences_text}: try `--by {next(iter(differing))}`."


def _differ_in(a: Compared, b: Compared, by: str) -> bool:
    """Return whether two values differ only in one part that both use, on the same λ."""
    if by == "run":
        return a.value == b.value and a.labels["run"] != b.labels["run"]
    unused = [name for name in _KEYS if NOT_USED in (a.labels[name], b.labels[name])]
    keys = _KEYS[by]
    is_equal = all(
        a.value.get(key) == b.value.get(key)
        for key in {*a.value, *b.value} - {*keys, *unused}
    )
    differ = any(a.value.get(key) != b.value.get(key) for key in keys)
    return is_equal and differ and by not in unused and _field(a) == _field(b)


def _field(condition: Compared) -> dict[str, Any]:
    """Return the settings of a world that determine the drawn λ.

    Immobilising terrain is among them if λ is frozen; time budgets never are.
    """
    world = condition.value["world"]
    if world["noise"] != "frozen":
        return {"noise": world["noise"]}
    below = (world.get("immobile") or {}).get("below")
    drawn = {key: world.get(key) for key in ("correlation_m", "kernel")}
    return {"noise": "frozen", **drawn, "immobile.below": below}


def _pair(first: Compared, second: Compared, by: str) -> Pair:
    names = f"{first.labels[by]!r} and {second.labels[by]!r}"
    check_maps(first, second, names)
    paired = side_by_side(first.episodes, second.episodes, _MEASURES)
    if paired.empty:
        raise ConfigError(
            f"Expected conditions with episodes in common, got {names} with "
            f"{_draws(first)} and {_draws(second)}."
        )
    shared = {
        name: second.labels[name]
        if first.labels[name] == NOT_USED
        else first.labels[name]
        for name in (*LABELS, "run")
        if name != by
    }
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
    """Return the common episodes of two conditions, a row each.

    Args:
        first: rows of a condition.
        second: rows of the other condition.
        measures: columns of both, those of `second` with `_other`.

    Returns:
        `DRAW`, the measures, and `group`.
    """
    columns = [*DRAW, *measures]
    return first[["group", *columns]].merge(
        second[columns], on=DRAW, suffixes=("", "_other")
    )


def on_common_draws(conditions: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Return the episodes that all conditions have in common, in one order.

    Args:
        conditions: rows of each condition, by id.
    """
    draws = [
        set(rows[DRAW].itertuples(index=False, name=None))
        for rows in conditions.values()
    ]
    common = pd.DataFrame(sorted(set.intersection(*draws)), columns=DRAW, dtype=int)
    return {
        condition: common.merge(rows, on=DRAW) for condition, rows in conditions.items()
    }


def check_maps(first: Compared, second: Compared, names: str) -> None:
    """Check that two conditions have the same maps, with one meaning and grouping.

    Raises:
        ConfigError: If maps of one index have different digests, or what the maps mean
            or their groups differ.
    """
    common = min(len(first.maps), len(second.maps))
    if list(first.maps[:common]) != list(second.maps[:common]):
        raise ConfigError(
            f"Expected conditions on the same maps, got {names}, whose maps have "
            "other digests."
        )
    first_groups = first.episodes.groupby("map")["group"].first()
    second_groups = second.episodes.groupby("map")["group"].first()
    common_maps = first_groups.index.intersection(second_groups.index)
    has_meaning = bool(first.about and second.about)
    same_groups = first_groups[common_maps].equals(second_groups[common_maps])
    unlike = {
        MEANING: has_meaning and first.about != second.about,
        "groups of maps": not same_groups,
    }
    if any(unlike.values()):
        split = f"of {first.value['data']} {first.value['split']}"
        differing = ", ".join(
            f"{name} {split}" for name, differs in unlike.items() if differs
        )
        raise ConfigError(
            f"Expected conditions on maps of one meaning, got {names}, which differ "
            f"in {differing}. Run them on one "
            "dataset."
        )


def _draws(condition: Compared) -> str:
    rows = condition.episodes
    numbers = {
        name: ", ".join(map(str, sorted(rows[name].unique())))
        for name in ("seed", "realisation")
    }
    return ", ".join(f"{name}s {listed}" for name, listed in numbers.items())
