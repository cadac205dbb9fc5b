"""What tables, sentences and figures of a run call things, and how they write numbers."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.experiment.condition import KNOWLEDGE, NOT_USED
from benchnav.eval.stats.best import BLOCK
from benchnav.planning.world.outcome import FAILURES
from benchnav.stats.tables import p_value, short
from benchnav.viz.style import planner_name, risk_name

# Columns of the summary that count failures, by how these ended, and what sentences
# call them.
FAILURE_COUNTS = {
    f"{outcome.name.lower()}_count": outcome.name.lower().replace("_", " ")
    for outcome in FAILURES
}
_READ = {"planner": planner_name, "risk": risk_name}
NOT_YET = "not yet a test"  # of a hypothesis, while its run is not finished
# Labels that tell conditions of one map apart.
NAMING = ("planner", "risk", "model", *KNOWLEDGE, "robot", "objective", "world")


def differ(labels: Iterable[str]) -> bool:
    """Tells whether labels differ; of a condition that uses none of it, it does not
    count.
    """
    return len(set(labels) - {NOT_USED}) > 1


def reading_name(column: str, label: str) -> str:
    """What a reader of a table or figure calls a label: planners and risk settings as
    papers write them.

    Args:
        column: of the label, such as `risk`.
        label: as it is typed, and stands in CSV and Parquet.
    """
    named = _READ.get(column)
    return named(label) if named else label


def reading_names(labels: str) -> str:
    """Labels with commas between, as `run.json` names the conditions of a hypothesis,
    as readers call them.
    """
    return ", ".join(planner_name(risk_name(label)) for label in labels.split(", "))


def naming_labels(summary: pd.DataFrame) -> list[str]:
    """The labels that name a condition beside planner and risk: model and what robots
    know, where these differ.
    """
    return [name for name in ("model", *KNOWLEDGE) if differ(summary[name])]


def blocks(summary: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Titles and rows of the blocks of a run: by scenario, and by what else of a block
    differs.
    """
    keys = [name for name in BLOCK if name == "scenario" or summary[name].nunique() > 1]
    return [
        (", ".join(map(str, key)), rows)
        for key, rows in summary.groupby(keys, sort=False)
    ]


def condition_name(labels: Mapping[str, Any], several: Collection[str] = ()) -> str:
    """A condition by its planner and its risk setting, and by what else tells it from
    others.

    Args:
        labels: of the condition; what it does not use is `NOT_USED`.
        several: labels that differ among the conditions shown, of `model`, `world` and
            what robots know.
    """
    beside = [
        labels[name] for name in ("model", *KNOWLEDGE, "world") if name in several
    ]
    # A planner that is given λ itself has a model and no risk setting; a blind one has
    # neither.
    if labels["risk"] == NOT_USED and "model" not in several:
        beside.insert(0, labels["model"])
    return joined([planner_name(labels["planner"]), *beside, risk_name(labels["risk"])])


def episode_names(labels: Sequence[Mapping[str, str]]) -> list[str]:
    """Name episodes that are shown together, each by planner and risk setting and by
    what else differs.

    Args:
        labels: of the condition of each.
    """
    several = [
        name for name in NAMING if differ(own.get(name, NOT_USED) for own in labels)
    ]
    more = [name for name in ("robot", "objective") if name in several]
    return [
        joined([condition_name(own, several), *(own[name] for name in more)])
        for own in labels
    ]


def with_names(summary: pd.DataFrame) -> pd.DataFrame:
    """Rows of conditions with the `name` of each among them."""
    several = naming_labels(summary)
    return summary.assign(
        name=[condition_name(row, several) for row in summary.to_dict("records")]
    )


def contender_names(labels: Sequence[Mapping[str, str]]) -> list[str]:
    """Names conditions by those of their labels that tell them apart; by their planner
    where nothing does.

    Args:
        labels: of each condition.
    """
    differing = [
        name for name in NAMING if differ(own.get(name, NOT_USED) for own in labels)
    ]
    names = []
    for own in labels:
        shown = {name: reading_name(name, label) for name, label in own.items()}
        names.append(
            joined(shown.get(name, NOT_USED) for name in differing) or shown["planner"]
        )
    return names


def joined(labels: Iterable[str]) -> str:
    """Labels with commas between, without those that are not used."""
    return ", ".join(label for label in labels if label != NOT_USED)


def unit_of_statistics(summary: pd.DataFrame) -> str:
    """A map, or a group of maps where the dataset has such."""
    return "group" if (summary["n_groups"] < summary["n_maps"]).any() else "map"


def maps_in_words(maps: int | str, groups: int | str) -> str:
    """Says how many maps there are, and in how many groups where they have such."""
    return f"{maps} maps" if groups == maps else f"{maps} maps in {groups} groups"


def rate_in_words(row: Mapping[Any, Any]) -> str:
    """Writes a success rate in per cent, so that one failure of 200 does not read as
    none.
    """
    return short(100 * row["success_rate"])


def failures_in_words(row: Mapping[Any, Any]) -> str:
    """Says how a condition's failures ended, such as `2 stuck, 1 stalled`; a dash where
    there are none.

    Args:
        row: of the summary.
    """
    words = (
        f"{row[column]} {name}"
        for column, name in FAILURE_COUNTS.items()
        if row[column]
    )
    return ", ".join(words) or NOT_USED


def chosen_in_words(shown: int, known: int) -> str:
    """Say how conditions were chosen where not all are shown; empty where all are."""
    words = (
        f" Shown are {shown} of {known} conditions, as many successes as "
        "failures "
        "if possible."
    )
    return words if shown < known else ""


def outcome_in_words(outcome: str) -> str:
    """An outcome without underscores."""
    return outcome.replace("_", " ")


def p_in_words(p: float) -> str:
    """Writes a p-value for a sentence or a figure; one that is NaN is not computed
    before the run is finished.
    """
    if np.isnan(p):
        return NOT_YET
    return f"p {p_value(p)}" if p <= 1e-4 else f"p = {p_value(p)}"


def count_range(counts: Collection[int]) -> str:
    """Counts as one number, or from the least to the most."""
    least, most = min(counts), max(counts)
    return f"{least}" if least == most else f"{least} to {most}"


def mean_and_std(mean: float, std: float) -> str:
    """A mean with its standard deviation, where there are such."""
    if np.isnan(mean):
        return NOT_USED
    return f"{mean:.1f}" if np.isnan(std) else f"{mean:.1f} ± {std:.1f}"


def success_interval_in_words(row: Mapping[Any, Any]) -> str:
    """The 95 % interval of a success rate, in per cent."""
    return f"{100 * row['success_low']:.0f}–{100 * row['success_high']:.0f}"
