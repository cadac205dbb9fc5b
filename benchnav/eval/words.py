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
FAILURE_COUNTS = {
    f"{outcome.name.lower()}_count": outcome.name.lower().replace("_", " ")
    for outcome in FAILURES
}
_READ = {"planner": planner_name, "risk": risk_name}
NOT_YET = "not yet a test"  # of a hypothesis, while its run is not finished
# Labels that distinguish conditions on one map.
NAMING = ("planner", "risk", "model", *KNOWLEDGE, "robot", "objective", "world")


def differ(labels: Iterable[str]) -> bool:
    """Return whether labels differ, ignoring those not used."""
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
    keys = [name for name in BLOCK if name == "scenario" or summary[name].nunique() > 1]
    return [
        (", ".join(map(str, key)), rows)
        for key, rows in summary.groupby(keys, sort=False)
    ]


def condition_name(labels: Mapping[str, Any], several: Collection[str] = ()) -> str:
    """Return a condition's name: planner, risk setting and labels that differ.

    Args:
        labels: labels of the condition by column.
        several: columns that differ among the conditions shown: `model`, `world`,
            sensors and belief.
    """
    labels_shown = [
        labels[name] for name in ("model", *KNOWLEDGE, "world") if name in several
    ]
    # A planner given λ has a model but no risk setting; a blind one has neither.
    if labels["risk"] == NOT_USED and "model" not in several:
        labels_shown.insert(0, labels["model"])
    return joined(
        [planner_name(labels["planner"]), *labels_shown, risk_name(labels["risk"])]
    )


def episode_names(labels: Sequence[Mapping[str, str]]) -> list[str]:
    """Name episodes shown together by planner, risk setting and labels that differ.

    Args:
        labels: labels of each episode's condition.
    """
    several = [
        name for name in NAMING if differ(row.get(name, NOT_USED) for row in labels)
    ]
    extra = [name for name in ("robot", "objective") if name in several]
    return [
        joined([condition_name(row, several), *(row[name] for name in extra)])
        for row in labels
    ]


def with_names(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the summary with the `name` of each condition."""
    several = naming_labels(summary)
    return summary.assign(
        name=[condition_name(row, several) for row in summary.to_dict("records")]
    )


def contender_names(labels: Sequence[Mapping[str, str]]) -> list[str]:
    """Name conditions by the labels that differ; by their planner if none does.

    Args:
        labels: labels of each condition.
    """
    differing = [
        name for name in NAMING if differ(row.get(name, NOT_USED) for row in labels)
    ]
    names = []
    for row in labels:
        shown = {name: reading_name(name, label) for name, label in row.items()}
        names.append(
            joined(shown.get(name, NOT_USED) for name in differing) or shown["planner"]
        )
    return names


def joined(labels: Iterable[str]) -> str:
    """Join labels by commas, without those not used."""
    return ", ".join(label for label in labels if label != NOT_USED)


def unit_of_statistics(summary: pd.DataFrame) -> str:
    """Return the statistical unit: "map", or "group" if the dataset has groups."""
    return "group" if (summary["n_groups"] < summary["n_maps"]).any() else "map"


def maps_in_words(maps: int | str, groups: int | str) -> str:
    """Return the number of maps in words, and of groups if there are any."""
    return f"{maps} maps" if groups == maps else f"{maps} maps in {groups} groups"


def rate_in_words(row: Mapping[Any, Any]) -> str:
    """Return a success rate in per cent, precise enough to show 1 failure of 200."""
    return short(100 * row["success_rate"])


def failures_in_words(row: Mapping[Any, Any]) -> str:
    """Return counts of failures, such as `2 stuck, 1 stalled`; a dash for no failure.

    Args:
        row: row of the summary.
    """
    words = (
        f"{row[column]} {name}"
        for column, name in FAILURE_COUNTS.items()
        if row[column]
    )
    return ", ".join(words) or NOT_USED


def chosen_in_words(shown: int, total: int) -> str:
    """Return how the shown conditions were chosen; empty if all are shown."""
    words = (
        f" Shown are {shown} of {total} conditions, as many successes as failures if "
        "possible."
    )
    return words if shown < total else ""


def outcome_in_words(outcome: str) -> str:
    """Return an outcome without underscores."""
    return outcome.replace("_", " ")


def p_in_words(p: float) -> str:
    """Return a p-value for text; NaN means that the run is not finished."""
    if np.isnan(p):
        return NOT_YET
    return f"p {p_value(p)}" if p <= 1e-4 else f"p = {p_value(p)}"


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
    return f"{100 * row['success_low']:.0f}–{100 * row['success_high']:.0f}"
