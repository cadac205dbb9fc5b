"""Results of the hypotheses that were fixed before a run: sentences and a table."""

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
    tests: pd.DataFrame, manifest: Mapping[str, Any], unit: str
) -> dict[str, list[str]]:
    """Describe the result of each hypothesis.

    Args:
        tests: from `hypotheses.test_hypotheses`.
        manifest: contents of `run.json`.
        unit: statistical unit, from `words.unit_of_statistics`.

    Returns:
        Sentences by their title.
    """
    all_quantities = quantities(further_quantities(manifest))
    sentences = [
        f"{number}. {_capital(_claim(row, all_quantities))}: {_verdict(row)} "
        f"({_numbers(row, unit)})."
        for number, row in enumerate(tests.to_dict("records"), start=1)
    ]
    title = (
        "Hypotheses, fixed before the first unit was run (digest "
        f"{manifest['hypotheses']['digest']})"
    )
    return {title: [*sentences, *_extended(manifest)]}


def hypothesis_table(
    tests: pd.DataFrame,
    unit: str,
    quantities_by_name: Mapping[str, Quantity] = QUANTITIES,
) -> Table:
    """Format the tests, a row a hypothesis; a supported one is bold.

    Args:
        tests: from `hypotheses.test_hypotheses`.
        unit: statistical unit, from `words.unit_of_statistics`.
        quantities_by_name: quantities that conditions are compared by.
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
        Column("hypothesis", lambda row: _claim(row, quantities_by_name)),
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
            "margin decides the test before the correction. Below "
            f"{LEAST_MAPS} {unit}s only success has an interval.",
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
        text = (
            "the interval allows for rare failures that no episode showed, and p "
            "does not. So p can be small where the interval contains 0."
        )
        explained.append(("T_total", text))
    for quantity in quantities_by_name.values():
        if quantity.of_arrivals and (tests["metric"] == quantity.name).any():
            explained.append(
                (quantity.words, "over the episodes in which both reached the goal.")
            )
    return replace(table, explained=(*table.explained, *explained))


def _claim(row: Mapping[Any, Any], quantities_by_name: Mapping[str, Quantity]) -> str:
    """Return the hypothesis, with conditions named as in tables and figures."""
    test = Hypothesis(**{name.name: row[name.name] for name in fields(Hypothesis)})
    first, second = map(reading_names, row["names"])
    return test.claim(first, second, quantities_by_name[test.metric])


def _verdict(row: Mapping[Any, Any]) -> str:
    if np.isnan(row["p_holm"]):
        return f"partial: {NOT_YET}"
    kind = row["kind"]
    direction = row["direction"]
    if kind in _OF_MARGINS:
        return _OF_MARGINS[kind] if row["supported"] else f"{kind} not shown"
    if row["supported"]:
        return f"significantly {direction or 'different'}"
    if direction:
        return f"not significantly {direction}"
    return "no significant difference"


def _numbers(row: Mapping[Any, Any], unit: str) -> str:
    words = [f"difference {_with_unit(row)}"]
    if (ends := _interval(row)) != NOT_USED:
        words.append(f"interval {ends}")
    p = [] if np.isnan(row["p_holm"]) else [p_in_words(row["p_holm"])]
    return ", ".join([*words, *p, f"{row['n_maps']} {unit}s"])


def _extended(manifest: Mapping[str, Any]) -> list[str]:
    """Return a note if a run was extended after its hypotheses were fixed."""
    planned = manifest["hypotheses"]["episodes"]
    now = {
        condition: sum(
            count for _, _, count in manifest["conditions"][condition]["draws"]
        )
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
    low = row[f"low{suffix}"]
    high = row[f"high{suffix}"]
    if np.isnan(low):
        return NOT_USED
    return f"{_signed(low)} to {_signed(high)} ({words})"


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
