"""Which conditions are compared: those whose values differ in one thing, on the same
maps and the same draws of λ.
"""

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

# By what conditions may differ, each with its keys in a condition's value. Other data
# or scenarios are other maps.
_KEYS: Mapping[str, tuple[str, ...]] = {
    **{
        name: (name,)
        for name in ("risk", "planner", "model", "objective", "robot", *KNOWLEDGE)
    },
    "world": ("world", "rules"),
    "run": (),
}
# Of an episode, what pairs hold of both sides.
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
    """A condition of one of the runs, or of several that hold the same.

    Args:
        labels: what tables call it, by column; `run` among them, `NOT_USED` where no
            two runs share a condition.
        value: all that bears on its rows, as `run.json` holds it.
        maps: digests of its maps, in the order of maps.
        episodes: its rows, with T of each as `time_budget_s`.
        code: what code made the rows, by run: names of sources, versions and parts with
            what identifies them.
        about: digest of what the maps mean, `MEANING`; empty where the run does not
            have it.
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
        one: label of what is compared.
        other: and with what.
        shared: labels of the two; of a label that one of them does not use, the
            other's.
        episodes: of both, paired by seed, realisation and map, on all maps that both
            met: one's `success`, `total_time_s`, `time_budget_s` and other measures,
            the other's with `_other`; and `group`, the statistical unit. Maps may have
            unequally many.
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
    """Pairs conditions whose values differ in one thing alone.

    What a condition does not use, such as the risk setting of a blind planner, is like
    any other.

    Args:
        conditions: conditions of one run or several, each once unless runs are compared
            with each other.
        by: what differs, see `by_what`.
        against: a label, which all others are compared with; all pairs when not given.

    Returns:
        Pairs, those with the same other labels together.

    Raises:
        ConfigError: there is nothing to compare, or it cannot be paired.
    """
    by = by_what(conditions, by, against)
    values = list(
        dict.fromkeys(
            condition.labels[by]
            for condition in conditions
            if condition.labels[by] != NOT_USED
        )
    )
    if against:
        check_known("`against`", against, values)
    pairs = [_pair(one, other, by) for one, other in matches(conditions, by, against)]
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
    """Yield the conditions of each pair that `find_pairs` makes: what is compared, and
    with what.

    Args:
        conditions: as there.
        by: from `by_what`.
        against: as there.
    """
    for a, b in combinations(conditions, 2):
        if _differ_in(a, b, by) and (
            not against or against in (a.labels[by], b.labels[by])
        ):
            # The later of the two comes first, unless the earlier is compared with a
            # named one.
            yield (a, b) if against and b.labels[by] == against else (b, a)


def by_what(conditions: Sequence[Compared], by: str = "", against: str = "") -> str:
    """By what conditions are compared, of the keys of `_KEYS`.

    Args:
        conditions: the conditions.
        by: what was asked for. When empty: that in which `against` is found; `run`
            where runs share conditions; else `risk`.
        against: a label, or empty.

    Raises:
        ConfigError: `by` is none, or `against` is found nowhere or in several.
    """
    if by:
        check_known("`by` (other data or scenarios are other maps)", by, _KEYS)
        return by
    if not against:
        return (
            "run"
            if any(condition.labels["run"] != NOT_USED for condition in conditions)
            else "risk"
        )
    labels = [
        (name, condition.labels[name]) for condition in conditions for name in _KEYS
    ]
    check_known(
        "`against`", against, sorted({label for _, label in labels} - {NOT_USED})
    )
    found = list(dict.fromkeys(name for name, label in labels if label == against))
    if len(found) > 1:
        raise ConfigError(
            f"Expected `against` to be a label of one kind, got {against!r}, a label "
            f"of {' and of '.join(found)}. Pass "
            f"--by {' or --by '.join(found)}."
        )
    return found[0]


def check_one_value_each(conditions: Iterable[Compared]) -> None:
    """Refuses two values under one label, which no reader of a table could distinguish.

    Raises:
        ConfigError: there are such.
    """
    known: dict[tuple[str, str], tuple[dict[str, Any], Compared]] = {}
    for condition in conditions:
        for name, keys in _KEYS.items():
            value = {key: condition.value.get(key) for key in keys}
            label = condition.labels[name]
            earlier, first = known.setdefault((name, label), (value, condition))
            if earlier != value and label != NOT_USED:
                runs = " and ".join(dict.fromkeys([*first.code, *condition.code]))
                raise ConfigError(
                    f"Expected one {name} under each label, got two that {runs} call "
                    f"{label!r}: "
                    f"{_in_words(earlier, value)}. Leave one of the runs out, or run "
                    "one again under "
                    "another label."
                )


def _in_words(one: Any, other: Any) -> str:
    """What differs between two values of plain data, with both, such as `options.level
    0.5 and 0.9`.
    """
    return ", ".join(
        f"{name} {first} and {second}"
        for name, first, second in differences(one, other)
    )


def _others(conditions: Sequence[Compared], by: str) -> str:
    """Names the labels in which the conditions do differ, or what is unlike in their
    worlds.
    """
    fields = {
        repr(field): field for condition in conditions if (field := _field(condition))
    }
    if by == "world" and len(fields) > 1:
        first, second, *_ = fields.values()
        return f" λ itself differs between their worlds: {_in_words(first, second)}."
    several = {
        name: labels
        for name in _KEYS
        if name != by
        and len(
            labels := {condition.labels[name] for condition in conditions} - {NOT_USED}
        )
        > 1
    }
    if not several:
        return ""
    told = " and ".join(
        f"{name} ({', '.join(sorted(labels))})" for name, labels in several.items()
    )
    return f" They differ in {told}: try `--by {next(iter(several))}`."


def _differ_in(one: Compared, other: Compared, by: str) -> bool:
    """Tells whether two values are alike in all but one thing, which both use, and met
    the same λ.
    """
    if by == "run":
        return one.value == other.value and one.labels["run"] != other.labels["run"]
    unused = [
        name for name in _KEYS if NOT_USED in (one.labels[name], other.labels[name])
    ]
    keys = _KEYS[by]
    alike = all(
        one.value.get(key) == other.value.get(key)
        for key in {*one.value, *other.value} - {*keys, *unused}
    )
    differ = any(one.value.get(key) != other.value.get(key) for key in keys)
    return alike and differ and by not in unused and _field(one) == _field(other)


def _field(condition: Compared) -> dict[str, Any]:
    """What of a world decides which λ is drawn; time budgets do not, and what
    immobilises does where λ is frozen.
    """
    world = condition.value["world"]
    if world["noise"] != "frozen":
        return {"noise": world["noise"]}
    below = (world.get("immobile") or {}).get("below")
    drawn = {key: world.get(key) for key in ("correlation_m", "kernel")}
    return {"noise": "frozen", **drawn, "immobile.below": below}


def _pair(one: Compared, other: Compared, by: str) -> Pair:
    names = f"{one.labels[by]!r} and {other.labels[by]!r}"
    check_maps(one, other, names)
    both = side_by_side(one.episodes, other.episodes, _MEASURES)
    if both.empty:
        raise ConfigError(
            f"Expected conditions with episodes in common, got {names} with "
            f"{_draws(one)} and {_draws(other)}."
        )
    shared = {
        name: other.labels[name] if one.labels[name] == NOT_USED else one.labels[name]
        for name in (*LABELS, "run")
        if name != by
    }
    return Pair(
        one=one.labels[by],
        other=other.labels[by],
        shared=shared,
        episodes=both,
        members=(one, other),
    )


def side_by_side(
    one: pd.DataFrame, other: pd.DataFrame, measures: Sequence[str]
) -> pd.DataFrame:
    """Episodes that two conditions have in common, a row each.

    Args:
        one: rows of a condition.
        other: rows of the other.
        measures: columns that are taken of both, the other's with `_other`.

    Returns:
        `DRAW`, the measures, and `group`.
    """
    columns = [*DRAW, *measures]
    return one[["group", *columns]].merge(
        other[columns], on=DRAW, suffixes=("", "_other")
    )


def on_common_draws(conditions: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Return the episodes that all conditions have in common, in one order; no rows
    where there are none.

    Args:
        conditions: rows of each.
    """
    draws = [
        set(rows[DRAW].itertuples(index=False, name=None))
        for rows in conditions.values()
    ]
    common = pd.DataFrame(sorted(set.intersection(*draws)), columns=DRAW, dtype=int)
    return {
        condition: common.merge(rows, on=DRAW) for condition, rows in conditions.items()
    }


def check_maps(one: Compared, other: Compared, names: str) -> None:
    """Checks that two conditions were evaluated on the same maps, with the same meaning
    and in the same groups.

    Raises:
        ConfigError: If maps of one index have different digests, or what the maps mean
            or their groups differ.
    """
    common = min(len(one.maps), len(other.maps))
    if list(one.maps[:common]) != list(other.maps[:common]):
        raise ConfigError(
            f"Expected conditions on the same maps, got {names}, whose maps have "
            "other digests."
        )
    groups, other_groups = (
        rows.groupby("map")["group"].first() for rows in (one.episodes, other.episodes)
    )
    both = groups.index.intersection(other_groups.index)
    unlike = {
        MEANING: bool(one.about and other.about) and one.about != other.about,
        "groups of maps": not groups[both].equals(other_groups[both]),
    }
    if any(unlike.values()):
        split = f"of {one.value['data']} {one.value['split']}"
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
