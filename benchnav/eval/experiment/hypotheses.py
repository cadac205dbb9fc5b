"""Hypotheses that a suite fixes before its first unit is run: what they claim, and how they are read.

A hypothesis compares two conditions by one metric: that they differ, or that one is not worse than the other by a
margin, or that they are equal to within it. `benchnav.eval.stats.hypotheses` tests them.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.condition import LABELS, NOT_USED, Condition

KINDS = ("difference", "non-inferiority", "equivalence")
DIRECTIONS = ("higher", "lower")

_KEYS = ("one", "other", "metric", "kind", "direction", "margin")


@dataclass(frozen=True, kw_only=True)
class Metric:
    """What two conditions are compared by.

    Args:
        column: of the table of episodes.
        name: in text.
        unit: of a difference and of a margin.
        scale: that unit over the column's.
        better: which way is better, of `DIRECTIONS`.
    """

    column: str
    name: str
    unit: str
    scale: float
    better: str


METRICS = {
    "success": Metric(column="success", name="success", unit="points", scale=100, better="higher"),
    "T_total": Metric(column="total_time_s", name="T_total", unit="s", scale=1, better="lower"),
    "score": Metric(column="score", name="score", unit="", scale=1, better="higher"),
    "traversability": Metric(column="traversability", name="λ̄", unit="points", scale=100, better="higher"),
    "path_length": Metric(column="path_length_m", name="path length", unit="m", scale=1, better="lower"),
}


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """What is claimed of two conditions.

    Args:
        one: id of the condition that the claim is about.
        other: id of the condition that it is compared with.
        names: what text calls the two.
        metric: of `METRICS`.
        kind: of `KINDS`.
        direction: of a difference, where `one` lies, or either way if empty; of non-inferiority, which way is better.
        margin: of non-inferiority and equivalence, in the metric's unit.
    """

    one: str
    other: str
    names: tuple[str, str]
    metric: str
    kind: str
    direction: str
    margin: float

    @property
    def claim(self) -> str:
        """The hypothesis as a sentence without its full stop."""
        metric = METRICS[self.metric]
        one, other = self.names
        margin = f"{self.margin:g} {metric.unit}".rstrip()
        if self.kind == "equivalence":
            return f"{metric.name} of {one} and of {other} differs by less than {margin}"
        if self.kind == "non-inferiority":
            worse = DIRECTIONS[self.direction == DIRECTIONS[0]]
            return f"{metric.name} of {one} is less than {margin} {worse} than that of {other}"
        if self.direction:
            return f"{metric.name} of {one} is {self.direction} than that of {other}"
        return f"{metric.name} of {one} differs from that of {other}"


def digest_of_tests(tests: Sequence[Mapping[str, Any]]) -> str:
    """Digest of hypotheses as `run.json` holds them, 16 hexadecimal digits."""
    text = json.dumps(tests, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def fix_hypotheses(
    given: Sequence[Mapping[str, Any]], conditions: Mapping[str, Condition], episodes: Mapping[str, int]
) -> dict[str, Any]:
    """Reads the hypotheses of a suite, for `run.json`.

    Args:
        given: as the suite lists them.
        conditions: its conditions by id.
        episodes: of each condition, how many are to be run.

    Returns:
        `tests`, each as plain data; `digest` of them; and `episodes` of each condition that they name. Empty where
        there are no hypotheses.

    Raises:
        ConfigError: a hypothesis names what is not there, or asks for what cannot be tested.
    """
    tests = [test for place, one in enumerate(given, start=1) for test in _read(one, place, conditions)]
    if not tests:
        return {}
    plain = [{**asdict(test), "names": list(test.names), "claim": test.claim} for test in tests]
    for test in plain:
        if plain.count(test) > 1:
            raise ConfigError(f"Expected hypotheses that differ, got twice: {test['claim']}.")
    named = dict.fromkeys(condition for test in tests for condition in (test.one, test.other))
    return {
        "tests": plain,
        "digest": digest_of_tests(plain),
        "episodes": {condition: episodes[condition] for condition in named},
    }


def _read(given: Mapping[str, Any], place: int, conditions: Mapping[str, Condition]) -> list[Hypothesis]:
    """A hypothesis of a suite: one test for each pair of conditions that it names."""
    where = f"hypothesis {place}"
    for key in given:
        if key not in _KEYS:
            raise ConfigError(
                f"Expected keys of {where} among {', '.join(_KEYS)}, got {key!r}.{registry.hint(str(key), _KEYS)}"
            )
    for key in ("one", "other", "metric"):
        if key not in given:
            raise ConfigError(f"Expected {where} with `one`, `other` and `metric`, got none of `{key}`.")
    metric = _choice(given["metric"], METRICS, "metric", where)
    kind = _choice(given.get("kind", "difference"), KINDS, "kind", where)
    direction = given.get("direction", "")
    if direction != "":
        direction = _choice(direction, DIRECTIONS, "direction", where)
    margin = given.get("margin", 0)
    if (
        isinstance(margin, bool)
        or not isinstance(margin, int | float)
        or not math.isfinite(margin)
        or margin < 0
    ):
        raise ConfigError(f"Expected `margin` of {where} to be a number ≥ 0, got {margin!r}.")
    if (kind == "difference") != (margin == 0):
        remedy = "Leave it out" if kind == "difference" else "Give one"
        unit = METRICS[metric].unit
        raise ConfigError(
            f"Expected `margin` of {where} where its kind is non-inferiority or equivalence, above 0"
            f"{f' in {unit}' if unit else ''}, got {margin:g} for {kind}. {remedy}."
        )
    if METRICS[metric].unit == "points" and margin >= 100:
        raise ConfigError(
            f"Expected `margin` of {where} below 100 points, got {margin:g}, which says nothing."
        )
    if kind == "equivalence" and direction:
        raise ConfigError(f"Expected no `direction` of {where}, an equivalence, got {direction!r}.")
    if kind == "non-inferiority":
        direction = direction or METRICS[metric].better
    sides = (
        _filter(given["one"], "one", where, conditions),
        _filter(given["other"], "other", where, conditions),
    )
    pairs = _pairs(*sides, where, conditions)
    if metric == "T_total":
        _check_one_budget(pairs, where, conditions)
    named = _names(pairs, sides, conditions)
    return [
        Hypothesis(
            one=one,
            other=other,
            names=names,
            metric=metric,
            kind=kind,
            direction=direction,
            margin=float(margin),
        )
        for (one, other), names in zip(pairs, named, strict=True)
    ]


def _choice(value: Any, known: Sequence[str] | Mapping[str, Any], name: str, where: str) -> str:
    if value not in list(known):
        raise ConfigError(
            f"Expected `{name}` of {where} among {', '.join(known)}, got {value!r}."
            f"{registry.hint(str(value), list(known))}"
        )
    return str(value)


def _filter(given: Any, side: str, where: str, conditions: Mapping[str, Condition]) -> dict[str, str]:
    """Labels by which a hypothesis names conditions."""
    if not isinstance(given, Mapping) or not given:
        raise ConfigError(
            f"Expected `{side}` of {where} to name a condition by labels, such as {{planner: mppi, risk: mean}}, got "
            f"{given!r}."
        )
    left = list(conditions.values())
    for name, value in given.items():
        if name not in LABELS:
            raise ConfigError(
                f"Expected labels in `{side}` of {where} among {', '.join(LABELS)}, got {name!r}."
                f"{registry.hint(str(name), LABELS)}"
            )
        known = list(dict.fromkeys(condition.labels[name] for condition in left))
        if str(value) not in known:
            raise ConfigError(
                f"Expected `{name}` of `{side}` of {where} among {', '.join(known)}, got {value!r}."
                f"{registry.hint(str(value), known)}"
            )
        left = [condition for condition in left if condition.labels[name] == str(value)]
    return {name: str(value) for name, value in given.items()}


def _pairs(
    one: Mapping[str, str], other: Mapping[str, str], where: str, conditions: Mapping[str, Condition]
) -> list[tuple[str, str]]:
    """Conditions that are named, each with that which is the same in all labels that neither side names."""
    free = [name for name in LABELS if name not in one and name not in other]
    sides = [
        [i for i, condition in conditions.items() if all(condition.labels[n] == v for n, v in side.items())]
        for side in (one, other)
    ]
    pairs = []
    for place, (own, others) in enumerate((sides, sides[::-1])):
        for first in own:
            partners = [i for i in others if i != first and _agree(conditions[first], conditions[i], free)]
            if len(partners) > 1:
                name = next(n for n in LABELS if len({conditions[i].labels[n] for i in partners}) > 1)
                raise ConfigError(
                    f"Expected {where} to name one condition to compare with another, got {len(partners)} that differ "
                    f"in {name} ({', '.join(conditions[i].labels[name] for i in partners)}). Name the {name} in "
                    f"`{('other', 'one')[place]}`."
                )
            pairs += [(first, i) for i in partners] if place == 0 else []
    if not pairs:
        raise ConfigError(
            f"Expected {where} to name two conditions that are the same in {', '.join(free) or 'all else'}, got "
            "none. Name in each what the other names."
        )
    for first, second in pairs:
        a, b = conditions[first], conditions[second]
        for name, of_a, of_b in (
            ("data", a.data, b.data), ("scenario", a.scenario, b.scenario), ("world", a.world, b.world)
        ):  # fmt: skip
            if of_a != of_b:
                raise ConfigError(
                    f"Expected {where} to compare conditions on the same maps under the same λ, got two of another "
                    f"{name}. Name one {name} in both."
                )
    return pairs


def _agree(one: Condition, other: Condition, free: Sequence[str]) -> bool:
    """Whether two conditions have the same labels; one that is not used goes with any."""
    return all(
        one.labels[name] == other.labels[name] or NOT_USED in (one.labels[name], other.labels[name])
        for name in free
    )


def _check_one_budget(
    pairs: Sequence[tuple[str, str]], where: str, conditions: Mapping[str, Condition]
) -> None:
    for first, second in pairs:
        one, other = conditions[first], conditions[second]
        if one.robot != other.robot and "time_budget_ratio" in one.world.to_dict():
            raise ConfigError(
                f"Expected {where} to compare T_total of conditions with one time budget, got robots whose T differs, "
                "which is what their failures count as. Compare their success, or give the world `time_budget_s`."
            )


def _names(
    pairs: Sequence[tuple[str, str]], sides: Sequence[Mapping[str, str]], conditions: Mapping[str, Condition]
) -> list[tuple[str, str]]:
    """What text calls the conditions: by the labels that name them, and by what else differs between the pairs."""
    several = {
        name
        for name in LABELS
        if not any(name in side for side in sides)
        and len({conditions[i].labels[name] for pair in pairs for i in pair} - {NOT_USED}) > 1
    }

    def name_of(condition: Condition, side: Mapping[str, str]) -> str:
        words = [condition.labels[name] for name in LABELS if name in side or name in several]
        return ", ".join(word for word in words if word != NOT_USED)

    one, other = sides
    return [(name_of(conditions[first], one), name_of(conditions[second], other)) for first, second in pairs]
