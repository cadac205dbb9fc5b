"""The table of a run: a row a trial, as the paper's Table I formats it, with notes under it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.stats.summary import LABELS
from benchnav.eval.trial import NOT_USED
from benchnav.planning.world.outcome import FAILURES

# What `follows` is where a planner follows the user's objective alone.
_USERS_OWN = ("", "J")
_ALWAYS = ("scenario", "planner", "risk")
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True, kw_only=True)
class ResultTable:
    """A table as text, for any way of writing it.

    Args:
        headings: one a column, those of labels first.
        labels: number of columns that are labels.
        rows: a row a trial.
        notes: what the raised numbers behind the planners' labels refer to, beginning with the number.
    """

    headings: tuple[str, ...]
    labels: int
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]


def result_table(summary: pd.DataFrame, trials: Mapping[str, Mapping[str, Any]]) -> ResultTable:
    """Formats a summary: rates and λ̄ in per cent, mean ± standard deviation over episodes.

    Columns of labels that are the same for all trials are left out, but for scenario, planner and risk; so
    are the numbers of maps and episodes.

    Args:
        summary: from `summary.summarise`.
        trials: by id what `run.json` knows of them: `follows` and `remarks` become notes.
    """
    shown = [name for name in LABELS if name in _ALWAYS or _differs(summary[name])]
    counts = [name for name in ("n_maps", "n_episodes") if summary[name].nunique() > 1]
    marks, notes = _notes(summary, trials)
    headings = (
        *shown,
        *(name.removeprefix("n_") for name in counts),
        "Succ. [%]",
        "95 % interval",
        "T_total [s]",
        "T if success [s]",
        "λ̄ [%]",
        "failures",
    )
    rows = []
    for row, mark in zip(summary.to_dict("records"), marks, strict=True):
        labels = [str(row[name]) + (mark if name == "planner" else "") for name in shown]
        rows.append((*labels, *(str(row[name]) for name in counts), *_results(row)))
    return ResultTable(headings=headings, labels=len(shown), rows=tuple(rows), notes=tuple(notes))


def failures_in_words(row: Mapping[Any, Any]) -> str:
    """Says how a trial's failures ended, such as `2 stuck, 1 stalled`; a dash where there are none.

    Args:
        row: of the summary.
    """
    names = [outcome.name.lower() for outcome in FAILURES]
    counts = {name.replace("_", " "): int(row[f"{name}_count"]) for name in names}
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count) or NOT_USED


def _results(row: Mapping[Any, Any]) -> tuple[str, ...]:
    met = _spread(100 * row["traversability_mean"], 100 * row["traversability_std"])
    # An episode that ended at once met nothing: its λ̄ is of fewer episodes than the row.
    if 0 < row["traversability_n"] < row["n_episodes"]:
        met += f" (n = {row['traversability_n']})"
    return (
        f"{100 * row['success_rate']:.0f}",
        f"{100 * row['success_low']:.0f}–{100 * row['success_high']:.0f}",
        _spread(row["total_time_mean_s"], row["total_time_std_s"]),
        _spread(row["success_time_mean_s"], row["success_time_std_s"]),
        met,
        failures_in_words(row),
    )


def _spread(mean: float, std: float) -> str:
    if np.isnan(mean):
        return NOT_USED
    return f"{mean:.1f}" if np.isnan(std) else f"{mean:.1f} ± {std:.1f}"


def _differs(labels: pd.Series) -> bool:
    """Tells whether a column has something to say; a planner that uses none of it does not count."""
    return labels[labels != NOT_USED].nunique() > 1


def _notes(summary: pd.DataFrame, trials: Mapping[str, Mapping[str, Any]]) -> tuple[list[str], list[str]]:
    """Raised numbers of each trial, and the notes that they refer to; equal texts share a number."""
    numbers: dict[str, int] = {}
    marks = []
    for trial in summary["trial"]:
        about = trials[trial]
        texts = [f"objective: {about['follows']}"] if about["follows"] not in _USERS_OWN else []
        own = [numbers.setdefault(text, len(numbers) + 1) for text in (*texts, *about["remarks"])]
        marks.append(",".join(_raised(number) for number in own))
    return marks, [f"{_raised(number)} {text}" for text, number in numbers.items()]


def _raised(number: int) -> str:
    return str(number).translate(_SUPERSCRIPTS)
