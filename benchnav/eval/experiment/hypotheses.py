"""Hypotheses that a suite fixes before its first unit is run.

A hypothesis compares two conditions by one metric. It claims that the conditions
differ, that the first is not worse by a margin, that the first is better by more than a
margin, or that they are equal to within a margin. `benchnav.eval.stats.hypotheses` tests
hypotheses.
"""

import itertools
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NoReturn

from benchnav.core.errors import ConfigError
from benchnav.core.quantity import Quantity
from benchnav.core.settings import check_known, of, read
from benchnav.core.store import text_digest
from benchnav.eval.experiment.condition import LABELS, NOT_USED, Condition, label_words
from benchnav.eval.experiment.unit import Conditions
from benchnav.metrics.shipped import QUANTITIES, TOTAL_TIME

_Pair = tuple[Condition, Condition]


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """A claim about two conditions, as written in a suite or as stored for its test.

    Args:
        one: condition that the claim is about: labels in a suite, an id in a test.
        other: condition that `one` is compared with: labels in a suite, an id in a
            test.
        metric: name of a metric.
        kind: claimed relation.
        direction: for a difference, whether `one` is claimed to be higher or lower; if
            empty, the test is two-sided. For non-inferiority and superiority, the
            better direction; if empty, the metric's better direction.
        margin: margin in the metric's unit, > 0; 0 for a difference.
    """

    one: Any
    other: Any
    metric: str
    kind: Literal["difference", "non-inferiority", "superiority", "equivalence"] = (
        "difference"
    )
    direction: Literal["", "higher", "lower"] = ""
    margin: float = 0.0

    def claim(self, first_name: str, second_name: str, quantity: Quantity) -> str:
        """Return the hypothesis as a sentence without a full stop.

        Args:
            first_name: name of the condition that the claim is about.
            second_name: name of the condition that it is compared with.
            quantity: quantity of the metric.
        """
        margin = f"{self.margin:g} {quantity.unit}".rstrip()
        subject = f"{quantity.words} of {first_name}"
        if self.kind == "equivalence":
            return f"{subject} and of {second_name} differs by less than {margin}"
        if self.kind == "non-inferiority":
            worse = "lower" if self.direction == "higher" else "higher"
            return f"{subject} is less than {margin} {worse} than that of {second_name}"
        if self.kind == "superiority":
            amount = f"more than {margin} {self.direction}"
            return f"{subject} is {amount} than that of {second_name}"
        if self.direction:
            return f"{subject} is {self.direction} than that of {second_name}"
        return f"{subject} differs from that of {second_name}"


def digest_of_tests(tests: Sequence[Mapping[str, Any]]) -> str:
    """Return the digest of the `tests` in `run.json`, 16 hexadecimal digits."""
    return text_digest(tests)[:16]


def fix_hypotheses(
    specs: Sequence[Mapping[str, Any]],
    conditions: Conditions,
    quantities: Mapping[str, Quantity] = QUANTITIES,
) -> dict[str, Any]:
    """Return the entry of a suite's hypotheses in `run.json`.

    Args:
        specs: hypotheses as the suite lists them.
        conditions: the suite's conditions by id, each with its extent.
        quantities: quantities by which conditions may be compared, by name.

    Returns:
        A mapping with three keys; empty if there are no hypotheses. `tests` is a list
        of tests as plain data, each with the fields of `Hypothesis`, `names` (the names
        of the two conditions in text) and `claim`. `digest` is the digest of `tests`.
        `episodes` is the number of episodes by id of each compared condition.

    Raises:
        ConfigError: If a hypothesis names an unknown metric or label, or cannot be
            tested.
    """
    candidates = [condition for condition, _ in conditions.values()]
    tests: list[dict[str, Any]] = []
    for number, spec in enumerate(specs, start=1):
        tests += _read(spec, f"hypothesis {number}", candidates, quantities)
    if not tests:
        return {}
    for test in tests:
        if tests.count(test) > 1:
            raise ConfigError(
                f"Expected hypotheses that differ, got the same one twice: "
                f"{test['claim']}. Leave one out."
            )
    episodes = {}
    for test in tests:
        for condition_id in (test["one"], test["other"]):
            _, extent = conditions[condition_id]
            episodes[condition_id] = extent.episodes
    return {"tests": tests, "digest": digest_of_tests(tests), "episodes": episodes}


def _read(
    spec: Mapping[str, Any],
    where: str,
    conditions: Sequence[Condition],
    quantities: Mapping[str, Quantity],
) -> list[dict[str, Any]]:
    """Return one test for each pair of conditions that a suite's hypothesis names."""
    hypothesis = read(Hypothesis, spec, of(where))
    check_known(f"`metric` of {where}", hypothesis.metric, quantities)
    quantity = quantities[hypothesis.metric]
    _check_margin(hypothesis, quantity, where)
    hypothesis = _with_direction(hypothesis, quantity, where)
    first_labels, first = _named(hypothesis.one, "one", where, conditions)
    second_labels, second = _named(hypothesis.other, "other", where, conditions)
    named = {*first_labels, *second_labels}
    unnamed = [name for name in LABELS if name not in named]
    pairs = _pairs(first, second, unnamed, where)
    if hypothesis.metric == TOTAL_TIME.name and any(map(_differ_in_budget, pairs)):
        raise ConfigError(
            f"Expected {where} to compare T_total of conditions with the same time "
            "budget T, got robots with different T. A failure counts as T. Compare "
            "success instead, or give the world `time_budget_s`."
        )
    # The name of a condition in text consists of the labels that the hypothesis gives
    # and of the other labels that vary between the pairs.
    labels = [condition.labels for pair in pairs for condition in pair]
    varying = [name for name in unnamed if _varies(labels, name)]
    tests = []
    for a, b in pairs:
        first_name = _name(a, [*first_labels, *varying])
        second_name = _name(b, [*second_labels, *varying])
        fields = asdict(replace(hypothesis, one=a.id, other=b.id))
        test = {"one": a.id, "other": b.id, "names": [first_name, second_name]}
        claim = hypothesis.claim(first_name, second_name, quantity)
        tests.append({**test, **fields, "claim": claim})
    return tests


def _check_margin(hypothesis: Hypothesis, quantity: Quantity, where: str) -> None:
    kind = hypothesis.kind
    margin = hypothesis.margin
    max_margin = 100 if quantity.unit == "points" else math.inf
    if kind == "difference" and margin:
        raise ConfigError(
            f"Expected no `margin` in {where}, got {margin:g}. A difference has no "
            "margin. Leave `margin` out."
        )
    if kind != "difference" and not 0 < margin < max_margin:
        raise ConfigError(
            f"Expected `margin` of {where} above 0 and below {max_margin} "
            f"{quantity.unit} for a claim of {kind}, got {margin:g}."
        )


def _with_direction(
    hypothesis: Hypothesis, quantity: Quantity, where: str
) -> Hypothesis:
    """Fill in the metric's better direction if the kind of hypothesis needs one."""
    kind = hypothesis.kind
    if kind == "equivalence" and hypothesis.direction:
        raise ConfigError(
            f"Expected no `direction` in {where}, got {hypothesis.direction!r}. An "
            "equivalence has no direction. Leave `direction` out."
        )
    if kind not in ("non-inferiority", "superiority") or hypothesis.direction:
        return hypothesis
    if quantity.better == "neither":
        raise ConfigError(
            f"Expected `direction` in {where} for a claim of {kind}, got none. Neither "
            f"direction of {hypothesis.metric!r} is better in itself. Set `direction` "
            "to higher or lower."
        )
    return replace(hypothesis, direction=quantity.better)


def _differ_in_budget(pair: _Pair) -> bool:
    first, second = pair
    has_ratio = first.world.time_budget_ratio is not None
    return has_ratio and first.robot != second.robot


def _varies(labels: Iterable[Mapping[str, str]], name: str) -> bool:
    values = {row[name] for row in labels}
    return len(values - {NOT_USED}) > 1


def _name(condition: Condition, columns: Sequence[str]) -> str:
    ordered = [name for name in LABELS if name in columns]
    return ", ".join(label_words(condition.labels, ordered))


def _named(
    spec: Any, side: str, where: str, conditions: Sequence[Condition]
) -> tuple[dict[str, str], list[Condition]]:
    """Return the labels that a hypothesis gives, and the conditions that have them."""
    if not isinstance(spec, Mapping) or not spec:
        raise ConfigError(
            f"Expected `{side}` of {where} to name a condition by labels, such as "
            f"{{planner: mppi, risk: mean}}, got {spec!r}."
        )
    matching = list(conditions)
    labels = {name: str(value) for name, value in spec.items()}
    for name, value in labels.items():
        check_known(f"labels in `{side}` of {where}", name, LABELS)
        options: dict[str, None] = {}
        for condition in matching:
            options |= dict.fromkeys(_labels_of(condition, name))
        check_known(f"`{name}` of `{side}` of {where}", value, options)
        matching = [c for c in matching if value in _labels_of(c, name)]
    return labels, matching


def _labels_of(condition: Condition, name: str) -> tuple[str, ...]:
    """Return the labels of a condition and of merged conditions, in one column."""
    return condition.labels[name], *condition.stands_for.get(name, ())


def _pairs(
    first: Sequence[Condition],
    second: Sequence[Condition],
    unnamed: Sequence[str],
    where: str,
) -> list[_Pair]:
    """Pair the conditions whose labels agree in all columns that neither side names."""
    combinations = list(itertools.product(first, second))
    pairs = [(a, b) for a, b in combinations if a.id != b.id and _agree(a, b, unnamed)]
    _check_one_to_one(pairs, where)
    if not pairs:
        _raise_no_pair(combinations, unnamed, where)
    for name in ("data", "scenario", "world"):
        if any(getattr(a, name) != getattr(b, name) for a, b in pairs):
            raise ConfigError(
                f"Expected {where} to compare conditions on the same maps with the "
                f"same draws of λ, got two that differ in {name}. Name the same {name} "
                "in `one` and `other`."
            )
    return pairs


def _agree(a: Condition, b: Condition, columns: Iterable[str]) -> bool:
    """Return whether the labels in all columns agree; `NOT_USED` agrees with any."""
    labels = [{a.labels[name], b.labels[name]} - {NOT_USED} for name in columns]
    return all(len(values) <= 1 for values in labels)


def _check_one_to_one(pairs: Sequence[_Pair], where: str) -> None:
    """Reject pairs in which a condition is compared with several others."""
    for index, side in enumerate(("other", "one")):
        partners = defaultdict(list)
        for pair in pairs:
            partners[pair[index].id].append(pair[1 - index].labels)
        for labels in partners.values():
            if len(labels) == 1:
                continue
            for name in LABELS:
                values = [row[name] for row in labels]
                if len(set(values)) > 1:
                    break
            raise ConfigError(
                f"Expected {where} to compare each condition with one other, got "
                f"{len(labels)} others that differ in {name} ({', '.join(values)}). "
                f"Name the {name} in `{side}`."
            )


def _raise_no_pair(
    combinations: Iterable[_Pair], unnamed: Sequence[str], where: str
) -> NoReturn:
    for a, b in combinations:
        if a.id != b.id or not a.stands_for:
            continue
        settings = []
        for kind, labels in a.stands_for.items():
            settings.append(f"{kind} {', '.join(labels)}")
        raise ConfigError(
            f"Expected {where} to compare two conditions, got one: planner "
            f"{a.labels['planner']!r} does not use {' and '.join(settings)}, so that "
            "both sides name the same condition. Leave the hypothesis out."
        )
    equal = ", ".join(unnamed) or "all other columns"
    raise ConfigError(
        f"Expected {where} to name two conditions with the same labels in {equal}, got "
        "none. Name these labels in `one` and `other`."
    )
