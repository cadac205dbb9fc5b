"""Which trials are compared: those of one run or several that met the same maps under the same luck."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import pandas as pd

from benchnav import registry
from benchnav.errors import ConfigError
from benchnav.eval.stats.summary import LABELS
from benchnav.eval.trial import NOT_USED

# By what trials may differ. Other data or scenarios are other maps.
COMPARED = ("risk", "planner", "model", "objective", "robot", "world", "run")
_LUCK = ["seed", "realisation", "instance"]


@dataclass(frozen=True, kw_only=True)
class Compared:
    """A trial of one of the runs.

    Args:
        labels: what tables call it, by column; `run` among them, `NOT_USED` where no two runs share a trial.
        world: what λ did, as plain data.
        maps: digests of its maps, in the order of instances.
        episodes: its rows, with T of each as `time_budget_s`.
    """

    labels: Mapping[str, str]
    world: Mapping[str, Any]
    maps: Sequence[str]
    episodes: pd.DataFrame


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two trials, and their episodes side by side.

    Args:
        one: what is compared.
        other: with what.
        shared: labels of the two; of a label that one of them does not use, the other's.
        episodes: of both, one's `success`, `total_time_s` and `time_budget_s`, the other's with `_other`; maps of
            which one trial has fewer episodes are left out.
        left_out: episodes of either trial that the other does not have.
    """

    one: str
    other: str
    shared: Mapping[str, str]
    episodes: pd.DataFrame
    left_out: int


def find_pairs(trials: Sequence[Compared], by: str = "", against: str = "") -> list[Pair]:
    """Pairs trials that differ in one label alone.

    A label that a trial does not use, such as the risk setting of a blind planner, is like any other.

    Args:
        trials: of one run or several.
        by: the label, of `COMPARED`. When not given: that in which `against` is found; `run` where runs share
            trials; else `risk`.
        against: a value of the label, which all others are compared with; all pairs when not given.

    Returns:
        Pairs, those with the same other labels together.

    Raises:
        ConfigError: there is nothing to compare, or it cannot be paired.
    """
    by = by or _label_of(trials, against)
    if by not in COMPARED:
        why = " Other data or scenarios are other maps." if by in ("data", "scenario") else ""
        raise ConfigError(
            f"Expected `by` among {', '.join(COMPARED)}, got {by!r}.{registry.hint(by, COMPARED)}{why}"
        )
    values = list(dict.fromkeys(trial.labels[by] for trial in trials if trial.labels[by] != NOT_USED))
    if against and against not in values:
        raise ConfigError(
            f"Expected `against` among {', '.join(values)}, got {against!r}.{registry.hint(against, values)}"
        )
    pairs = [
        _pair(*_ordered(a, b, by, against), by)
        for a, b in combinations(trials, 2)
        if _differ_in(a, b, by) and (not against or against in (a.labels[by], b.labels[by]))
    ]
    if not pairs:
        raise ConfigError(
            f"Expected two trials or more that differ in their {by} and in nothing else, got {by} "
            f"{', '.join(values) or NOT_USED}.{_others(trials, by)}"
        )
    families = list(dict.fromkeys(tuple(pair.shared.values()) for pair in pairs))
    return sorted(pairs, key=lambda pair: families.index(tuple(pair.shared.values())))


def _label_of(trials: Sequence[Compared], against: str) -> str:
    if not against:
        return "run" if any(trial.labels["run"] != NOT_USED for trial in trials) else "risk"
    found = [name for name in COMPARED if any(trial.labels[name] == against for trial in trials)]
    if not found:
        known = sorted({trial.labels[name] for trial in trials for name in COMPARED} - {NOT_USED})
        raise ConfigError(
            f"Expected `against` among {', '.join(known)}, got {against!r}.{registry.hint(against, known)}"
        )
    if len(found) > 1:
        raise ConfigError(f"Expected `by` {' or '.join(found)}: both have {against!r}.")
    return found[0]


def _others(trials: Sequence[Compared], by: str) -> str:
    """Names the labels in which the trials do differ."""
    several = {
        name: labels
        for name in COMPARED
        if name != by and len(labels := {trial.labels[name] for trial in trials} - {NOT_USED}) > 1
    }
    if not several:
        return ""
    told = " and ".join(f"{name} ({', '.join(sorted(labels))})" for name, labels in several.items())
    return f" They differ in {told}: try `--by {next(iter(several))}`."


def _differ_in(one: Compared, other: Compared, by: str) -> bool:
    a, b = one.labels, other.labels
    alike = all(
        a[name] == b[name] or NOT_USED in (a[name], b[name]) for name in (*LABELS, "run") if name != by
    )
    return alike and a[by] != b[by] and NOT_USED not in (a[by], b[by])


def _ordered(a: Compared, b: Compared, by: str, against: str) -> tuple[Compared, Compared]:
    """What is compared first: the later of the two, unless the earlier is compared with a named one."""
    return (a, b) if against and b.labels[by] == against else (b, a)


def _pair(one: Compared, other: Compared, by: str) -> Pair:
    names = f"{one.labels[by]!r} and {other.labels[by]!r}"
    if one.world != other.world:
        raise ConfigError(
            f"Expected trials that met the same λ, got {names}, in whose worlds it differs "
            f"({_difference(one, other)}), so that their episodes are no pairs."
        )
    common = min(len(one.maps), len(other.maps))
    if list(one.maps[:common]) != list(other.maps[:common]):
        raise ConfigError(f"Expected trials on the same maps, got {names}, whose maps have other digests.")
    columns = [*_LUCK, "success", "total_time_s", "time_budget_s"]
    grouped = [*columns, "group"] if "group" in one.episodes else columns
    both = one.episodes[grouped].merge(other.episodes[columns], on=_LUCK, suffixes=("", "_other"))
    if both.empty:
        raise ConfigError(
            f"Expected trials with episodes in common, got {names} with {_luck(one)} and {_luck(other)}."
        )
    draws = both.groupby("instance")["success"].transform("size")
    both = both[draws == draws.mode().max()]  # maps with as many draws as most episodes have
    left_out = len(one.episodes) + len(other.episodes) - 2 * len(both)
    shared = {
        name: other.labels[name] if one.labels[name] == NOT_USED else one.labels[name]
        for name in (*LABELS, "run")
        if name != by
    }
    return Pair(one=one.labels[by], other=other.labels[by], shared=shared, episodes=both, left_out=left_out)


def _difference(one: Compared, other: Compared) -> str:
    names = dict.fromkeys([*one.world, *other.world])
    told = [
        f"{name} {one.world.get(name)} and {other.world.get(name)}"
        for name in names
        if one.world.get(name) != other.world.get(name)
    ]
    return ", ".join(told)


def _luck(trial: Compared) -> str:
    def listed(values: Iterable[Any]) -> str:
        return ", ".join(str(value) for value in sorted(set(values)))

    rows = trial.episodes
    return f"seeds {listed(rows['seed'])}, realisations {listed(rows['realisation'])}"
