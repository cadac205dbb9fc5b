"""What a run says of the hypotheses that were fixed before it: sentences, and their
table.
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.core.tables import Bold, Table
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.experiment.hypotheses import Hypothesis
from benchnav.eval.experiment.metrics import further_quantities, quantities
from benchnav.eval.words import NOT_YET, count_range, p_in_words, reading_names
from benchnav.metrics.shipped import QUANTITIES, TOTAL_TIME
from benchnav.stats.bootstrap import LEAST_MAPS
from benchnav.stats.holm import ALPHA
from benchnav.stats.tables import Column, p_value, signed, table_of

_TESTS = {
    "difference": "sign-flip test by {unit} (difference)",
    "non-inferiority": "one-sided test at the margin (non-inferiority)",
    "superiority": "one-sided test at the margin (superiority)",
    "equivalence": "two one-sided tests (TOST) at the margin (equivalence)",
}
_OF_MARGINS = {
    "equivalence": "equivalent",
    "non-inferiority": "not inferior",
    "superiority": "superior",
}


def hypothesis_findings(
    tests: pd.DataFrame, about: Mapping[str, Any], unit: str
) -> dict[str, list[str]]:
    """Says of each hypothesis how its test came out.

    Args:
        tests: from `hypotheses.test_hypotheses`.
        about: all of `run.json`.
        unit: of the statistics, from `words.unit_of_statistics`.

    Returns:
        Sentences by the title over them.
    """
    known = quantities(further_quantities(about))
    said = [
        f"{number}. {_capital(_claim(row, known))}: {_verdict(row)} "
        f"({_numbers(row, unit)})."
        for number, row in enumerate(tests.to_dict("records"), start=1)
    ]
    title = (
        "Hypotheses, fixed before the first unit was run (digest "
        f"{about['hypotheses']['digest']})"
    )
    return {title: [*said, *_extended(about)]}


def hypothesis_table(
    tests: pd.DataFrame, unit: str, known: Mapping[str, Quantity] = QUANTITIES
) -> Table:
    """Formats the tests, a row a hypothesis; bold where it is supported.

    Args:
        tests: from `hypotheses.test_hypotheses`.
        unit: of the statistics, from `words.unit_of_statistics`.
        known: what conditions are compared by, by name.
    """
    used = "; ".join(
        words for kind, words in _TESTS.items() if (tests["kind"] == kind).any()
    )
    family = "1 hypothesis" if len(tests) == 1 else f"{len(tests)} hypotheses"
    notes = [
        f"Tests: {used.format(unit=unit)}; p is corrected over {family} (Holm). "
        f"Supported: p < {ALPHA}.",
        "Intervals are of one difference and not corrected, so that an interval and p "
        "can disagree.",
    ]
    rows = [
        {**row, "number": number}
        for number, row in enumerate(tests.to_dict("records"), start=1)
    ]
    columns = [
        Column("", lambda row: str(row["number"])),
        Column("hypothesis", lambda row: _claim(row, known)),
        Column(f"{unit}s", lambda row: str(row["n_maps"])),
        Column(
            "values",
            lambda row: f"{_value(row['mean_one'])} : {_value(row['mean_other'])}",
            "of the first condition and of the second.",
        ),
        Column("difference", _with_unit),
        Column(
            "interval",
            _interval,
            "95 % for a difference; 90 % for a margin, where the end beyond the "
            "margin decides the test before the "
            f"correction. Under {LEAST_MAPS} {unit}s success alone has an interval.",
        ),
        Column(
            "p",
            lambda row: NOT_USED if np.isnan(row["p_holm"]) else p_value(row["p_holm"]),
        ),
        Column(
            "result",
            lambda row: Bold(_verdict(row)) if row["supported"] else _verdict(row),
        ),
    ]
    table = table_of(
        rows,
        columns,
        labels=2,
        notes=tuple(notes),
        bold_note="supported." if tests["supported"].any() else "",
    )
    explained = []
    if ((tests["metric"] == TOTAL_TIME.name) & (tests["kind"] == "difference")).any():
        explained.append(
            (
                "T_total",
                "the interval allows for rare failures that no episode showed, and p "
                "does not. So p can be small where "
                "the interval holds 0.",
            )
        )
    for quantity in known.values():
        if quantity.of_arrivals and (tests["metric"] == quantity.name).any():
            explained.append(
                (quantity.words, "over the episodes in which both arrived.")
            )
    return replace(table, explained=(*table.explained, *explained))


def _claim(row: Mapping[Any, Any], known: Mapping[str, Quantity]) -> str:
    """The hypothesis with the names that tables and figures have for the two
    conditions.
    """
    test = Hypothesis(**{name.name: row[name.name] for name in fields(Hypothesis)})
    one, other = map(reading_names, row["names"])
    return test.claim(one, other, known[test.metric])


def _verdict(row: Mapping[Any, Any]) -> str:
    if np.isnan(row["p_holm"]):
        return f"partial: {NOT_YET}"
    kind, direction = row["kind"], row["direction"]
    if kind in _OF_MARGINS:
        return _OF_MARGINS[kind] if row["supported"] else f"{kind} not shown"
    if row["supported"]:
        return f"significantly {direction or 'different'}"
    return (
        f"not significantly {direction}" if direction else "no significant difference"
    )


def _numbers(row: Mapping[Any, Any], unit: str) -> str:
    words = [f"difference {_with_unit(row)}"]
    if (ends := _interval(row)) != NOT_USED:
        words.append(f"interval {ends}")
    p = [] if np.isnan(row["p_holm"]) else [p_in_words(row["p_holm"])]
    return ", ".join([*words, *p, f"{row['n_maps']} {unit}s"])


def _extended(about: Mapping[str, Any]) -> list[str]:
    """Tells where a run was extended after its hypotheses were fixed."""
    planned = about["hypotheses"]["episodes"]
    now = {
        condition: sum(count for _, _, count in about["conditions"][condition]["draws"])
        for condition in planned
    }
    if now == planned:
        return []
    return [
        "The run was extended after the hypotheses were fixed (episodes a condition: "
        f"{count_range(planned.values())} "
        f"then, {count_range(now.values())} now). The p-values hold only if that was "
        "planned."
    ]


def _interval(row: Mapping[Any, Any]) -> str:
    # The interval whose end decides a test at 5 %, before a correction.
    suffix, words = ("_90", "90 %") if row["kind"] in _OF_MARGINS else ("", "95 %")
    low, high = row[f"low{suffix}"], row[f"high{suffix}"]
    return (
        NOT_USED if np.isnan(low) else (f"{_signed(low)} to {_signed(high)} ({words})")
    )


def _with_unit(row: Mapping[Any, Any]) -> str:
    value = row["difference"]
    return NOT_USED if np.isnan(value) else f"{_signed(value)} {row['unit']}".rstrip()


def _signed(value: float) -> str:
    return signed(value, 1 if abs(value) >= 0.95 else 2)


def _value(value: float) -> str:
    return NOT_USED if np.isnan(value) else f"{value:.3g}"


def _capital(text: str) -> str:
    # Symbols such as λ̄ stay as they are.
    return text[0].upper() + text[1:] if text[0].isascii() else text
