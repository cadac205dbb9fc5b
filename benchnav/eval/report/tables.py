"""The table of a run: a row a condition, as the paper's Table I formats it, with notes under it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.experiment.condition import LABELS, NOT_USED
from benchnav.eval.stats.best import BLOCK, PRIVILEGED, competing
from benchnav.eval.stats.comparison import ALPHA
from benchnav.eval.stats.difference import LEAST_MAPS
from benchnav.planning.world.outcome import FAILURES

# What `follows` is where a planner follows the user's objective alone.
_USERS_OWN = ("", "J")
_ALWAYS = ("scenario", "planner", "risk")
ALONE, IN_BATCH = "one robot [ms]", "per episode of a batch [ms]"
LATENCIES = ("median_ms", "p95_ms", "max_ms")
# What columns hold, by heading; only those that are shown are explained.
_COLUMNS = {
    "data": "the dataset.",
    "scenario": "the kind of ground; a scenario is a test split of the dataset.",
    "world": "what λ does during an episode, and the rules of the task.",
    "robot": "how the robot moves.",
    "objective": "what planners are asked to minimise.",
    "model": "what predicts λ; ideal, oracle and clairvoyant are privileged: they are given part of the truth.",
    "planner": "what chooses the actions.",
    "risk": "how the predicted distribution of λ becomes the one number λ̂ that the planner is given.",
    "groups": "number of groups of maps that the condition was run on; the statistics take a group as one.",
    "maps": "number of maps that the condition was run on.",
    "episodes": "number of episodes of the condition.",
    "Succ. [%]": "share of episodes that reached the goal.",
    "95 % interval": "of the success rate: Wilson's, with maps as the unit, so that episodes on one map count as fewer "
    "the more alike they end.",
    "T_total [s]": "mean time to the goal, a failure counted as T; in brackets its 95 % interval over maps, from "
    f"those of the success rate and of the time of arrival; none under {LEAST_MAPS} maps.",
    "T if success [s]": "mean ± standard deviation of the time over the episodes that reached the goal.",
    "λ̄ [%]": "mean observed λ during an episode, mean ± standard deviation over episodes.",
    ALONE: "wall time of planning one step of one robot alone on one thread, replanning included: the median, and in "
    "brackets the 95th percentile and the maximum, over at most 100 steps of one episode after its first.",
    IN_BATCH: "wall time of planning one step of a batch of at most 50 episodes on one thread over their number, which "
    "is no latency: the median over an episode's steps and in brackets their 95th percentile, each as its median over "
    "episodes; ¶ marks planners that were compiled.",
    "failures": "how the other episodes ended.",
}
# Of the columns that not every run has, that of the summary which says so.
_TIMES = {ALONE: "latency_median_ms", IN_BATCH: "planning_ms_median"}
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True, kw_only=True)
class ResultTable:
    """A table as text, for any way of writing it.

    Args:
        headings: one a column, those of labels first.
        labels: number of columns that are labels.
        rows: a row a condition.
        notes: what the raised numbers behind the planners' labels refer to, beginning with the number.
        bold: cells (row, column) that are set in bold.
        bold_note: what bold means.
        explained: what columns hold, (heading, sentence).
    """

    headings: tuple[str, ...]
    labels: int
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]
    bold: frozenset[tuple[int, int]] = frozenset()
    bold_note: str = ""
    explained: tuple[tuple[str, str], ...] = ()


def result_table(summary: pd.DataFrame, conditions: Mapping[str, Mapping[str, Any]]) -> ResultTable:
    """Formats a summary: rates and λ̄ in per cent; bold what is not significantly worse than the best.

    Columns of labels that are the same for all conditions are left out, but for scenario, planner and risk; so
    are the numbers of maps and episodes.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best` and perhaps with latencies.
        conditions: by id what `run.json` knows of them: `follows` and `remarks` become notes.
    """
    shown = [name for name in LABELS if name in _ALWAYS or _differs(summary[name])]
    grouped = is_grouped(summary)
    counts = [
        name for name in ("n_groups", "n_maps", "n_episodes")
        if summary[name].nunique() > 1 and (grouped or name != "n_groups")
    ]  # fmt: skip
    marks, notes = _notes(summary, conditions)
    headings = (
        *shown,
        *(name.removeprefix("n_") for name in counts),
        "Succ. [%]",
        "95 % interval",
        "T_total [s]",
        "T if success [s]",
        "λ̄ [%]",
        *(heading for heading, name in _TIMES.items() if name in summary and summary[name].notna().any()),
        "failures",
    )
    rows = []
    for row, mark in zip(summary.to_dict("records"), marks, strict=True):
        labels = [str(row[name]) + (mark if name == "planner" else "") for name in shown]
        results = _results(row)
        rows.append(
            (*labels, *(str(row[name]) for name in counts), *(results[h] for h in headings if h in results))
        )
    if any("¶" in cell for row in rows for cell in row):
        notes.append("¶ compiled planner: its time is that of compiled code.")
    rate = headings.index("Succ. [%]")
    marked = [place for place, value in enumerate(summary["best_marked"]) if value]
    return ResultTable(
        headings=headings,
        labels=len(shown),
        rows=tuple(rows),
        notes=tuple(notes),
        bold=frozenset((place, rate) for place in marked),
        bold_note=bold_note(summary) if marked else "",
        explained=tuple((heading, _COLUMNS[heading]) for heading in headings),
    )


def bold_note(summary: pd.DataFrame) -> str:
    """Says what bold means in a table of a run.

    Args:
        summary: as in `result_table`.
    """
    words = ["not significantly worse than the highest success rate of its block"]
    by = "group" if is_grouped(summary) else "map"
    words.append(
        f"(max-T sign-flip test by {by} over the block, step by step, p ≥ {ALPHA}); in blocks where nothing is "
        "significantly worse none is marked"
    )
    left_out = [
        summary.loc[rows.index[~competing(rows)]]
        for _, rows in summary.groupby(list(BLOCK), sort=False, dropna=False)
    ]
    told = pd.concat(left_out).sort_values(
        "privileged", key=lambda parts: parts.map(PRIVILEGED.index), kind="stable"
    )
    if not told.empty:
        out = ", ".join(dict.fromkeys(told["model"]))
        words.append(f"; privileged models ({out}) do not compete")
    return " ".join(words).replace(" ;", ";") + "."


def is_grouped(summary: pd.DataFrame) -> bool:
    """Whether the unit of the statistics is a group of maps."""
    return bool((summary["n_groups"] < summary["n_maps"]).any())


def maps_in_words(maps: int | str, groups: int | str) -> str:
    """Says how many maps there are, and in how many groups where they have such."""
    return f"{maps} maps" if groups == maps else f"{maps} maps in {groups} groups"


def rate_in_words(row: Mapping[Any, Any]) -> str:
    """Writes a success rate in per cent, so that one failure of 200 does not read as none."""
    return f"{100 * row['success_rate']:.1f}".removesuffix(".0")


def failures_in_words(row: Mapping[Any, Any]) -> str:
    """Says how a condition's failures ended, such as `2 stuck, 1 stalled`; a dash where there are none.

    Args:
        row: of the summary.
    """
    names = [outcome.name.lower() for outcome in FAILURES]
    counts = {name.replace("_", " "): int(row[f"{name}_count"]) for name in names}
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count) or NOT_USED


def _results(row: Mapping[Any, Any]) -> dict[str, str]:
    met = _spread(100 * row["traversability_mean"], 100 * row["traversability_std"])
    compiled = "¶" if row["compiled_share"] > 0 and not np.isnan(row["planning_ms_median"]) else ""
    # An episode that ended at once met nothing: its λ̄ is of fewer episodes than the row.
    if 0 < row["traversability_n"] < row["n_episodes"]:
        met += f" (n = {row['traversability_n']})"
    return {
        "Succ. [%]": rate_in_words(row),
        "95 % interval": f"{100 * row['success_low']:.0f}–{100 * row['success_high']:.0f}",
        "T_total [s]": _with_interval(
            row["total_time_mean_s"], row["total_time_low_s"], row["total_time_high_s"]
        ),
        "T if success [s]": _spread(row["success_time_mean_s"], row["success_time_std_s"]),
        "λ̄ [%]": met,
        ALONE: _times(*(row.get(f"latency_{name}", np.nan) for name in LATENCIES)),
        IN_BATCH: _times(row["planning_ms_median"], row["planning_ms_p95_median"]) + compiled,
        "failures": failures_in_words(row),
    }


def _times(middle: float, *others: float) -> str:
    """Milliseconds by two digits that count; earlier versions did not measure the others."""
    if np.isnan(middle):
        return NOT_USED
    first, *rest = (
        np.format_float_positional(value, 2, fractional=False, trim="-")
        for value in (middle, *others)
        if not np.isnan(value)
    )
    return f"{first} ({', '.join(rest)})" if rest else first


def _with_interval(mean: float, low: float, high: float) -> str:
    return f"{mean:.1f}" if np.isnan(low) else f"{mean:.1f} ({low:.1f}–{high:.1f})"


def _spread(mean: float, std: float) -> str:
    if np.isnan(mean):
        return NOT_USED
    return f"{mean:.1f}" if np.isnan(std) else f"{mean:.1f} ± {std:.1f}"


def _differs(labels: pd.Series) -> bool:
    """Tells whether a column has something to say; a planner that uses none of it does not count."""
    return labels[labels != NOT_USED].nunique() > 1


def _notes(summary: pd.DataFrame, conditions: Mapping[str, Mapping[str, Any]]) -> tuple[list[str], list[str]]:
    """Raised numbers of each condition, and the notes that they refer to; equal texts share a number."""
    numbers: dict[str, int] = {}
    marks = []
    for condition in summary["condition"]:
        about = conditions[condition]
        follows = about["follows"]
        texts = [] if follows in _USERS_OWN else [f"minimises, in place of the task's J: {follows}"]
        own = [numbers.setdefault(text, len(numbers) + 1) for text in (*texts, *about["remarks"])]
        marks.append(",".join(_raised(number) for number in own))
    return marks, [f"{_raised(number)} {text}" for text, number in numbers.items()]


def _raised(number: int) -> str:
    return str(number).translate(_SUPERSCRIPTS)
