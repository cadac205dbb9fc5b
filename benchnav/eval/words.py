"""Names of conditions, and notation of numbers, in tables, sentences and figures."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.experiment.condition import KNOWLEDGE, NOT_USED
from benchnav.eval.stats.best import BLOCK
from benchnav.planning.world.outcome import FAILURES
from benchnav.stats.tables import p_value, short
from benchnav.viz.style import planner_name, risk_name

# Columns of the summary that count failures of each outcome, and their names in text.
_FAILURES = [outcome.name.lower() for outcome in FAILURES]
FAILURE_COUNTS = {f"{name}_count": name.replace("_", " ") for name in _FAILURES}
_READ = {"planner": planner_name, "risk": risk_name}
NOT_YET = "not yet a test"  # of a hypothesis, while its run is not finished
# Labels that distinguish conditions on one map.
NAMING = ("planner", "risk", "model", *KNOWLEDGE, "robot", "objective", "world")


def differ(labels: Iterable[str]) -> bool:
    """Return whether labels differ, apart from labels of unused parts."""
    return len(set(labels) - {NOT_USED}) > 1


def reading_name(column: str, label: str) -> str:
    """Return a label as papers write it, for tables and figures.

    Args:
        column: column of the label, such as `risk`.
        label: label as typed and stored.
    """
    written = _READ.get(column)
    return written(label) if written else label


def reading_names(labels: str) -> str:
    """Return comma-separated labels, such as a hypothesis has, as papers write them."""
    return ", ".join(planner_name(risk_name(label)) for label in labels.split(", "))


def naming_labels(summary: pd.DataFrame) -> list[str]:
    """Return the columns that name a condition in addition to planner and risk."""
    return [name for name in ("model", *KNOWLEDGE) if differ(summary[name])]


def blocks(summary: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Return title and rows of each block of a run."""
    differing = [name for name in BLOCK if summary[name].nunique() > 1]
    keys = [name for name in BLOCK if name == "scenario" or name in differing]
    titled = []
    for labels, rows in summary.groupby(keys, sort=False):
        title = ", ".join(map(str, labels))
        titled.append((title, rows))
    return titled


def condition_name(labels: Mapping[str, Any], several: Collection[str] = ()) -> str:
    """Return a condition's name: planner, risk setting and labels that differ.

    Args:
        labels: labels of the condition by column.
        several: columns that differ among the conditions shown: `model`, `world`,
            sensors and belief.
    """
    columns = [name for name in ("model", *KNOWLEDGE, "world") if name in several]
    # A planner given λ has a model but no risk setting; a blind planner has neither.
    if labels["risk"] == NOT_USED and "model" not in several:
        columns.insert(0, "model")
    planner = planner_name(labels["planner"])
    risk = risk_name(labels["risk"])
    return joined([planner, *(labels[name] for name in columns), risk])


def episode_names(labels: Sequence[Mapping[str, str]]) -> list[str]:
    """Name episodes shown together by planner, risk setting and labels that differ.

    Args:
        labels: labels of each episode's condition.
    """
    several = _differing(labels)
    extra = [name for name in ("robot", "objective") if name in several]
    names = []
    for row in labels:
        further = [row[name] for name in extra]
        names.append(joined([condition_name(row, several), *further]))
    return names


def _differing(labels: Sequence[Mapping[str, str]]) -> list[str]:
    """Return the columns of `NAMING` in which conditions differ."""
    return [
        name for name in NAMING if differ(row.get(name, NOT_USED) for row in labels)
    ]


def with_names(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the summary with the `name` of each condition."""
    several = naming_labels(summary)
    names = [condition_name(row, several) for row in summary.to_dict("records")]
    return summary.assign(name=names)


def contender_names(labels: Sequence[Mapping[str, str]]) -> list[str]:
    """Name conditions by the labels that differ, or by their planner if no label does.

    Args:
        labels: labels of each condition.
    """
    differing = _differing(labels)
    names = []
    for row in labels:
        shown = {name: reading_name(name, label) for name, label in row.items()}
        name = joined(shown.get(column, NOT_USED) for column in differing)
        names.append(name or shown["planner"])
    return names


def joined(labels: Iterable[str]) -> str:
    """Join labels by commas, without labels of unused parts."""
    return ", ".join(label for label in labels if label != NOT_USED)


def unit_of_statistics(summary: pd.DataFrame) -> str:
    """Return the statistical unit: "map", or "group" if the dataset has groups."""
    has_groups = summary["n_groups"] < summary["n_maps"]
    return "group" if has_groups.any() else "map"


def maps_in_words(maps: int | str, groups: int | str) -> str:
    """Return the number of maps in words, and the number of groups if there are any."""
    return f"{maps} maps" if groups == maps else f"{maps} maps in {groups} groups"


def rate_in_words(row: Mapping[Any, Any]) -> str:
    """Return a success rate in per cent, precise enough to show 1 failure of 200."""
    return short(100 * row["success_rate"])


def failures_in_words(row: Mapping[Any, Any]) -> str:
    """Return counts of failures, such as `2 stuck, 1 stalled`; a dash for no failure.

    Args:
        row: row of the summary.
    """
    words = []
    for column, name in FAILURE_COUNTS.items():
        if row[column]:
            words.append(f"{row[column]} {name}")
    return ", ".join(words) or NOT_USED


def chosen_in_words(shown: int, total: int) -> str:
    """Describe the choice of the shown conditions; empty if all are shown."""
    if shown >= total:
        return ""
    return (
        f" Shown are {shown} of {total} conditions, as many successes as failures if "
        "possible."
    )


def outcome_in_words(outcome: str) -> str:
    """Return an outcome without underscores."""
    return outcome.replace("_", " ")


def p_in_words(p: float) -> str:
    """Return a p-value for text; NaN means that the run is not finished."""
    if np.isnan(p):
        return NOT_YET
    sign = "" if p <= 1e-4 else "= "  # `p_value` writes ≤ itself
    return f"p {sign}{p_value(p)}"


def count_range(counts: Collection[int]) -> str:
    """Return counts as one number, or as a range."""
    minimum = min(counts)
    maximum = max(counts)
    return f"{minimum}" if minimum == maximum else f"{minimum} to {maximum}"


def mean_and_std(mean: float, std: float) -> str:
    """Return a mean with its standard deviation; a dash for NaN."""
    if np.isnan(mean):
        return NOT_USED
    return f"{mean:.1f}" if np.isnan(std) else f"{mean:.1f} ± {std:.1f}"


def success_interval_in_words(row: Mapping[Any, Any]) -> str:
    """Return the 95 % interval of a success rate, in per cent."""
    low = 100 * row["success_low"]
    high = 100 * row["success_high"]
    return f"{low:.0f}–{high:.0f}"
