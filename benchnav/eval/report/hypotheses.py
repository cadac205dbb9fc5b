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
from benchnav.eval.words import NOT_YET, count_range, display_names, p_in_words
from benchnav.metrics.shipped import QUANTITIES, TOTAL_TIME
from benchnav.stats.bootstrap import LEAST_MAPS
from benchnav.stats.holm import ALPHA
from benchnav.stats.tables import Column, cell_of, p_value, signed, table_of

_TESTS = {
    "difference": "sign-flip test by {unit} (difference)",
    "non-inferiority": "one-sided test at the margin (non-inferiority)",
    "superiority": "one-sided test at the margin (superiority)",
    "equivalence": "two one-sided tests (TOST) at the margin (equivalence)",
}
_MARGIN_VERDICTS = {
    "equivalence": "equivalent",
    "non-inferiority": "not inferior",
    "superiority": "superior",
}


def hypothesis_findings(
    tests: pd.DataFrame, manifest: Mapping[str, Any], unit: str
) -> dict[str, list[str]]:
    """Describe the result of each hypothesis.

    Args:
        tests: table from `hypotheses.test_hypotheses`.
        manifest: contents of `run.json`.
        unit: statistical unit, from `words.unit_of_statistics`.

    Returns:
        Sentences by title; there is one title.
    """
    all_quantities = quantities(further_quantities(manifest))
    sentences = []
    for number, row in enumerate(tests.to_dict("records"), start=1):
        claim = _capital(_claim(row, all_quantities))
        verdict = f"{_verdict(row)} ({_numbers(row, unit)})"
        sentences.append(f"{number}. {claim}: {verdict}.")
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
    """Format the tests, one row per hypothesis, with bold results if supported.

    Args:
        tests: table from `hypotheses.test_hypotheses`.
        unit: statistical unit, from `words.unit_of_statistics`.
        quantities_by_name: quantities by which conditions are compared.
    """
    kinds = set(tests["kind"])
    used = "; ".join(words for kind, words in _TESTS.items() if kind in kinds)
    family = "1 hypothesis" if len(tests) == 1 else f"{len(tests)} hypotheses"
    notes = (
        f"Tests: {used.format(unit=unit)}; p is corrected over {family} (Holm). "
        f"Supported: p < {ALPHA}.",
        "Each interval is for one difference and is not corrected, so an interval and "
        "its p can disagree.",
    )
    rows = tests.assign(number=range(1, len(tests) + 1)).to_dict("records")
    columns = [
        Column("", cell_of("number")),
        Column("hypothesis", lambda row: _claim(row, quantities_by_name)),
        Column(f"{unit}s", cell_of("n_maps")),
        Column("values", _values, "of the first condition and of the second."),
        Column("difference", _with_unit),
        Column(
            "interval",
            _interval,
            "95 % for a difference; 90 % for a margin, where the limit next to the "
            "margin decides the test before correction. With fewer than "
            f"{LEAST_MAPS} {unit}s, only success has an interval.",
        ),
        Column("p", cell_of("p_holm", _p)),
        Column("result", _result),
    ]
    bold_note = "supported." if tests["supported"].any() else ""
    table = table_of(rows, columns, n_labels=2, notes=notes, bold_note=bold_note)
    explained = []
    is_of_time = tests["metric"] == TOTAL_TIME.name
    is_difference = tests["kind"] == "difference"
    if (is_of_time & is_difference).any():
        text = (
            "the interval allows for rare failures that did not occur, but p does "
            "not. Hence p can be small although the interval contains 0."
        )
        explained.append(("T_total", text))
    for quantity in quantities_by_name.values():
        if quantity.of_arrivals and (tests["metric"] == quantity.name).any():
            text = "over the episodes in which both conditions reach the goal."
            explained.append((quantity.words, text))
    return replace(table, explained=(*table.explained, *explained))


def _claim(row: Mapping[Any, Any], quantities_by_name: Mapping[str, Quantity]) -> str:
    """Return the claim of a hypothesis, with names of conditions as in tables.

    Names with commas are in brackets, which show where a name ends.
    """
    names = [field.name for field in fields(Hypothesis)]
    test = Hypothesis(**{name: row[name] for name in names})
    first, second = (_in_brackets(display_names(name)) for name in row["names"])
    return test.claim(first, second, quantities_by_name[test.metric])


def _in_brackets(name: str) -> str:
    return f"({name})" if ", " in name else name


def _result(row: Mapping[Any, Any]) -> str:
    verdict = _verdict(row)
    return Bold(verdict) if row["supported"] else verdict


def _verdict(row: Mapping[Any, Any]) -> str:
    if np.isnan(row["p_holm"]):
        return f"partial: {NOT_YET}"
    kind = row["kind"]
    direction = row["direction"]
    if kind in _MARGIN_VERDICTS:
        return _MARGIN_VERDICTS[kind] if row["supported"] else f"{kind} not shown"
    if row["supported"]:
        return f"significantly {direction or 'different'}"
    if direction:
        return f"not significantly {direction}"
    return "no significant difference"


def _numbers(row: Mapping[Any, Any], unit: str) -> str:
    words = [f"difference {_with_unit(row)}"]
    interval = _interval(row)
    if interval != NOT_USED:
        words.append(f"interval {interval}")
    p = row["p_holm"]
    if not np.isnan(p):
        words.append(p_in_words(p))
    words.append(f"{row['n_maps']} {unit}s")
    return ", ".join(words)


def _extended(manifest: Mapping[str, Any]) -> list[str]:
    """Return a note if a run was extended after its hypotheses were fixed."""
    planned = manifest["hypotheses"]["episodes"]
    now = {}
    for condition in planned:
        draws = manifest["conditions"][condition]["draws"]
        now[condition] = sum(count for _, _, count in draws)
    if now == planned:
        return []
    return [
        "The run was extended after the hypotheses were fixed (episodes per condition: "
        f"{count_range(planned.values())} then, {count_range(now.values())} now). "
        "The p-values are valid only if this extension was planned."
    ]


def _interval(row: Mapping[Any, Any]) -> str:
    # A limit of this interval decides a test at 5 %, before correction.
    has_margin = row["kind"] in _MARGIN_VERDICTS
    suffix, level = ("_90", "90 %") if has_margin else ("", "95 %")
    low = row[f"low{suffix}"]
    high = row[f"high{suffix}"]
    if np.isnan(low):
        return NOT_USED
    return f"{_signed(low)} to {_signed(high)} ({level})"


def _with_unit(row: Mapping[Any, Any]) -> str:
    value = row["difference"]
    return NOT_USED if np.isnan(value) else f"{_signed(value)} {row['unit']}".rstrip()


def _signed(value: float) -> str:
    return signed(value, 1 if abs(value) >= 0.95 else 2)


def _values(row: Mapping[Any, Any]) -> str:
    return f"{_value(row['mean_one'])} : {_value(row['mean_other'])}"


def _p(p: float) -> str:
    return NOT_USED if np.isnan(p) else p_value(p)


def _value(value: float) -> str:
    return NOT_USED if np.isnan(value) else f"{value:.3g}"


def _capital(text: str) -> str:
    # A symbol such as λ̄ is not capitalised.
    return text[0].upper() + text[1:] if text[0].isascii() else text
