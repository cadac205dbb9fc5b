"""Hypotheses that a suite fixes before its first unit is run: what they claim, and how
they are read.

A hypothesis compares two conditions by one metric: that they differ, or that one is not
worse than the other by a margin, or better by more than it, or that they are equal to
within it. `benchnav.eval.stats.hypotheses` tests them.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from benchnav.core.errors import ConfigError
from benchnav.core.quantity import Quantity
from benchnav.core.settings import check_known, of, read
from benchnav.core.store import text_digest
from benchnav.eval.experiment.condition import LABELS, NOT_USED, Condition, label_words
from benchnav.eval.experiment.unit import Conditions
from benchnav.metrics.shipped import QUANTITIES, TOTAL_TIME


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """What is claimed of two conditions, as a suite writes it and as it is tested.

    Args:
        one: the condition that the claim is about, by labels in a suite, by its id in a
            test.
        other: the condition that it is compared with, as well.
        metric: name of a metric.
        kind: what is claimed of the difference.
        direction: of a difference, where `one` lies, or either way if empty; of
            non-inferiority and superiority, which way is better, the metric's if empty.
        margin: of all but a difference, in the metric's unit.
    """

    one: Any
    other: Any
    metric: str
    kind: Literal["difference", "non-inferiority", "superiority", "equivalence"] = (
        "difference"
    )
    direction: Literal["", "higher", "lower"] = ""
    margin: float = 0.0

    def claim(self, one: str, other: str, quantity: Quantity) -> str:
        """The hypothesis as a sentence without its full stop.

        Args:
            one: what text calls the condition that the claim is about.
            other: what it calls the other.
            quantity: that the two are compared by.
        """
        margin = f"{self.margin:g} {quantity.unit}".rstrip()
        if self.kind == "equivalence":
            return (
                f"{quantity.words} of {one} and of {other} differs by less than "
                f"{margin}"
            )
        if self.kind == "non-inferiority":
            worse = "lower" if self.direction == "higher" else "higher"
            return (
                f"{quantity.words} of {one} is less than {margin} {worse} than "
                f"that of {other}"
            )
        if self.kind == "superiority":
            return (
                f"{quantity.words} of {one} is more than {margin} "
                f"{self.direction} "
                f"than that of {other}"
            )
        if self.direction:
            return f"{quantity.words} of {one} is {self.direction} than that of {other}"
        return f"{quantity.words} of {one} differs from that of {other}"


def digest_of_tests(tests: Sequence[Mapping[str, Any]]) -> str:
    """Digest of hypotheses as `run.json` holds them, 16 hexadecimal digits."""
    return text_digest(tests)[:16]


def fix_hypotheses(
    given: Sequence[Mapping[str, Any]],
    conditions: Conditions,
    quantities: Mapping[str, Quantity] = QUANTITIES,
) -> dict[str, Any]:
    """Reads the hypotheses of a suite, for `run.json`.

    Args:
        given: as the suite lists them.
        conditions: its conditions by id, with how often each is to be run.
        quantities: what they may be compared by, by name.

    Returns:
        `tests`, each as plain data: the fields of `Hypothesis`, `names`, what text
        calls the two, and `claim`; `digest` of them; and `episodes` of each condition
        that they name. Empty where there are no hypotheses.

    Raises:
        ConfigError: a hypothesis names what is not there, or asks for what cannot be
            tested.
    """
    every = [condition for condition, _ in conditions.values()]
    tests = [
        test
        for place, one in enumerate(given, start=1)
        for test in _read(one, f"hypothesis {place}", every, quantities)
    ]
    if not tests:
        return {}
    for test in tests:
        if tests.count(test) > 1:
            raise ConfigError(
                f"Expected hypotheses that differ, got twice: {test['claim']}."
            )
    named = dict.fromkeys(test[side] for test in tests for side in ("one", "other"))
    return {
        "tests": tests,
        "digest": digest_of_tests(tests),
        "episodes": {
            condition: conditions[condition][1].episodes for condition in named
        },
    }


def _read(
    given: Mapping[str, Any],
    where: str,
    conditions: Sequence[Condition],
    quantities: Mapping[str, Quantity],
) -> list[dict[str, Any]]:
    """A hypothesis of a suite: one test for each pair of conditions that it names."""
    asked = read(Hypothesis, given, of(where))
    check_known(f"`metric` of {where}", asked.metric, quantities)
    quantity, kind, margin = quantities[asked.metric], asked.kind, asked.margin
    most = 100 if quantity.unit == "points" else math.inf
    if kind == "difference" and margin:
        raise ConfigError(
            f"Expected no `margin` of {where}, a difference, got {margin:g}. Leave it "
            "out."
        )
    if kind != "difference" and not 0 < margin < most:
        raise ConfigError(
            f"Expected `margin` of {where}, a test of {kind}, above 0 and below "
            f"{most} {quantity.unit}, got {margin:g}."
        )
    if kind == "equivalence" and asked.direction:
        raise ConfigError(
            f"Expected no `direction` of {where}, an equivalence, got "
            f"{asked.direction!r}."
        )
    if kind in ("non-inferiority", "superiority") and not asked.direction:
        if quantity.better == "neither":
            raise ConfigError(
                f"Expected `direction` of {where}, a test of {kind}, since no way is "
                f"better for {asked.metric!r}, got "
                "none. Say higher or lower."
            )
        asked = replace(asked, direction=quantity.better)
    one, ones = _named(asked.one, "one", where, conditions)
    other, others = _named(asked.other, "other", where, conditions)
    unnamed = [name for name in LABELS if name not in {**one, **other}]
    pairs = _pairs(ones, others, unnamed, where)
    if asked.metric == TOTAL_TIME.name and any(
        first.robot != second.robot and first.world.time_budget_ratio is not None
        for first, second in pairs
    ):
        raise ConfigError(
            f"Expected {where} to compare T_total of conditions with one time budget, "
            "got robots of different T, as "
            "which failures count. Compare their success, or give the world "
            "`time_budget_s`."
        )
    # Text calls conditions by the labels that name them, and by what else differs
    # between the pairs.
    labels = [condition.labels for pair in pairs for condition in pair]
    varying = {
        name for name in unnamed if len({own[name] for own in labels} - {NOT_USED}) > 1
    }
    tests = []
    for first, second in pairs:
        names = [
            ", ".join(
                label_words(
                    condition.labels, [n for n in LABELS if n in own or n in varying]
                )
            )
            for condition, own in ((first, one), (second, other))
        ]
        test = replace(asked, one=first.id, other=second.id)
        about = {"one": first.id, "other": second.id, "names": names, **asdict(test)}
        tests.append({**about, "claim": test.claim(*names, quantity)})
    return tests


def _named(
    given: Any, side: str, where: str, conditions: Sequence[Condition]
) -> tuple[dict[str, str], list[Condition]]:
    """Labels by which a hypothesis names conditions, and the conditions that have them."""
    if not isinstance(given, Mapping) or not given:
        raise ConfigError(
            f"Expected `{side}` of {where} to name a condition by labels, such as "
            f"{{planner: mppi, risk: mean}}, got "
            f"{given!r}."
        )
    left, labels = list(conditions), {name: str(value) for name, value in given.items()}
    for name, value in labels.items():
        check_known(f"labels in `{side}` of {where}", name, LABELS)
        known = dict.fromkeys(
            label for condition in left for label in _labels_of(condition, name)
        )
        check_known(f"`{name}` of `{side}` of {where}", value, known)
        left = [condition for condition in left if value in _labels_of(condition, name)]
    return labels, left


def _labels_of(condition: Condition, name: str) -> tuple[str, ...]:
    """Labels of a column by which a condition is named: its own, and those of the
    settings that it stands for.
    """
    return condition.labels[name], *condition.stands_for.get(name, ())


def _pairs(
    ones: Sequence[Condition],
    others: Sequence[Condition],
    unnamed: Sequence[str],
    where: str,
) -> list[tuple[Condition, Condition]]:
    """Conditions that are named, each with that which is the same in all labels that
    neither side names.
    """
    pairs = [
        (one, other)
        for one in ones
        for other in others
        # A label that is not used goes with any.
        if one.id != other.id
        and all(
            one.labels[name] == other.labels[name]
            or NOT_USED in (one.labels[name], other.labels[name])
            for name in unnamed
        )
    ]
    for place, side in enumerate(("other", "one")):
        partners = defaultdict(list)
        for pair in pairs:
            partners[pair[place].id].append(pair[1 - place].labels)
        several = next(
            (labels for labels in partners.values() if len(labels) > 1), None
        )
        if several:
            name = next(
                name for name in LABELS if len({labels[name] for labels in several}) > 1
            )
            raise ConfigError(
                f"Expected {where} to name one condition to compare with another, got "
                f"{len(several)} that differ in "
                f"{name} ({', '.join(labels[name] for labels in several)}). Name the "
                f"{name} in `{side}`."
            )
    itself = next(
        (
            one
            for one in ones
            for other in others
            if one.id == other.id and one.stands_for
        ),
        None,
    )
    if not pairs and itself:
        settings = " and ".join(
            f"{kind} {', '.join(own)}" for kind, own in itself.stands_for.items()
        )
        raise ConfigError(
            f"Expected {where} to compare two conditions, got one: planner "
            f"{itself.labels['planner']!r} does not use "
            f"{settings}. Leave the hypothesis out."
        )
    if not pairs:
        raise ConfigError(
            f"Expected {where} to name two conditions that are the same in "
            f"{', '.join(unnamed) or 'all else'}, got "
            "none. Name the same labels in `one` and `other`."
        )
    for name in ("data", "scenario", "world"):
        if any(getattr(one, name) != getattr(other, name) for one, other in pairs):
            raise ConfigError(
                f"Expected {where} to compare conditions on the same maps under the "
                "same λ, got two of another "
                f"{name}. Name one {name} in both."
            )
    return pairs
