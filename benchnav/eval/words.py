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

# Columns of the summary with the number of failures of each outcome, and names in text.
_FAILURES = [outcome.name.lower() for outcome in FAILURES]
FAILURE_COUNTS = {f"{name}_count": name.replace("_", " ") for name in _FAILURES}
# Functions from a stored label to the label as papers write it, by column.
_NAME_OF_LABEL = {"planner": planner_name, "risk": risk_name}
NOT_YET = "not yet a test"  # instead of p-values while the run is not finished
# Columns whose labels distinguish conditions on one map.
NAMING = ("planner", "risk", "model", *KNOWLEDGE, "robot", "objective", "world")
# Column of conditions without their world: changes of the rules of its preset.
_RULES = "rules"


def differ(labels: Iterable[str]) -> bool:
    """Return whether labels differ; `NOT_USED` is ignored."""
    return len(set(labels) - {NOT_USED}) > 1


def display_name(column: str, label: str) -> str:
    """Return a label as papers write it, for tables and figures.

    Args:
        column: column of the label, such as `risk`.
        label: label as stored.
    """
    to_name = _NAME_OF_LABEL.get(column)
    return to_name(label) if to_name else label


def display_names(labels: str) -> str:
    """Rewrite the comma-separated labels of a hypothesis as papers write them."""
    return ", ".join(planner_name(risk_name(label)) for label in labels.split(", "))


def naming_labels(summary: pd.DataFrame) -> list[str]:
    """Return the columns that name a condition in addition to planner and risk."""
    return [name for name in ("model", *KNOWLEDGE) if differ(summary[name])]


def blocks(summary: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Return the title and the rows of each block of a run, from its summary."""
    differing = [name for name in BLOCK if summary[name].nunique() > 1]
    keys = [name for name in BLOCK if name == "scenario" or name in differing]
    titled = []
    for labels, rows in summary.groupby(keys, sort=False):
        title = ", ".join(map(str, labels))
        titled.append((title, rows))
    return titled


def condition_name(labels: Mapping[str, Any], differing: Collection[str] = ()) -> str:
    """Return a condition's name: planner, risk setting and labels that differ.

    Args:
        labels: labels of the condition by column.
        differing: columns whose labels differ between the shown conditions; only
            `model`, `world`, sensors and belief are used.
    """
    columns = [name for name in ("model", *KNOWLEDGE, "world") if name in differing]
    # A planner that is given λ has a model but no risk setting; a blind planner has
    # neither.
    if labels["risk"] == NOT_USED and "model" not in differing:
        columns.insert(0, "model")
    planner = planner_name(labels["planner"])
    risk = risk_name(labels["risk"])
    return joined([planner, *(labels[name] for name in columns), risk])


def episode_names(labels: Sequence[Mapping[str, str]]) -> list[str]:
    """Name episodes shown together by planner, risk setting and labels that differ.

    Worlds have short names; see `world_names`.

    Args:
        labels: labels of each episode's condition.
    """
    differing = _differing(labels)
    worlds = world_names([row["world"] for row in labels])
    extra = [name for name in ("robot", "objective") if name in differing]
    names = []
    for row in labels:
        further = [row[name] for name in extra]
        short = {**row, "world": worlds[row["world"]]}
        names.append(joined([condition_name(short, differing), *further]))
    return names


def _differing(labels: Sequence[Mapping[str, str]]) -> list[str]:
    """Return the columns in which conditions differ."""
    return [
        name
        for name in (*NAMING, _RULES)
        if differ(row.get(name, NOT_USED) for row in labels)
    ]


def with_names(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the summary with a column `name` of the conditions' names."""
    differing = naming_labels(summary)
    names = [condition_name(row, differing) for row in summary.to_dict("records")]
    return summary.assign(name=names)


def contender_names(labels: Sequence[Mapping[str, str]]) -> list[str]:
    """Name conditions by the labels that differ; by planner if no label differs.

    Args:
        labels: labels of each condition.
    """
    differing = _differing(labels)
    names = []
    for row in labels:
        shown = {name: display_name(name, label) for name, label in row.items()}
        name = joined(shown.get(column, NOT_USED) for column in differing)
        names.append(name or shown["planner"])
    return names


def world_names(worlds: Sequence[str]) -> dict[str, str]:
    """Return short names of worlds by label, without `shared_words`.

    A label that has only these words keeps its first word, the preset.
    """
    shared = shared_words(worlds).split()
    names = {}
    for world in worlds:
        differing = [word for word in world.split() if word not in shared]
        names[world] = " ".join(differing or world.split()[:1])
    return names


def shared_words(worlds: Sequence[str]) -> str:
    """Return the words that the labels of all worlds share."""
    first, *others = [world.split() for world in worlds]
    return " ".join(word for word in first if all(word in other for other in others))


def joined(labels: Iterable[str]) -> str:
    """Join labels by commas, without `NOT_USED`."""
    return ", ".join(label for label in labels if label != NOT_USED)


def unit_of_statistics(summary: pd.DataFrame) -> str:
    """Return the statistical unit: "map", or "group" if the dataset has groups."""
    has_groups = summary["n_groups"] < summary["n_maps"]
    return "group" if has_groups.any() else "map"


def maps_in_words(maps: int | str, groups: int | str) -> str:
    """Return the number of maps in words, and of groups if the dataset has groups."""
    return f"{maps} maps" if groups == maps else f"{maps} maps in {groups} groups"


def rate_in_words(row: Mapping[Any, Any]) -> str:
    """Return a success rate in per cent that shows even 1 failure in 200 episodes."""
    return short(100 * row["success_rate"])


def failures_in_words(row: Mapping[Any, Any]) -> str:
    """Return counts of failures, such as `2 stuck, 1 stalled`; a dash without failure.

    Args:
        row: row of the summary.
    """
    words = []
    for column, name in FAILURE_COUNTS.items():
        if row[column]:
            words.append(f"{row[column]} {name}")
    return ", ".join(words) or NOT_USED


def chosen_in_words(shown: int, total: int) -> str:
    """Describe which conditions are shown; empty if all are shown."""
    if shown >= total:
        return ""
    return (
        f" The figure shows {shown} of {total} conditions, with equally many successes "
        "and failures if possible."
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
