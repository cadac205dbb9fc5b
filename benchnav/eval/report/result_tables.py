"""The tables of a run: a row a condition, and, for a paper, settings down and scenarios across; and of a comparison.

Source of the first two: Endo, Honda and Ishigami (2024), Table I.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.figures import planner_name
from benchnav.core.resampling import LEAST_MAPS
from benchnav.core.tables import Bold, Table, to_latex
from benchnav.eval.experiment.condition import LABELS, NOT_USED
from benchnav.eval.report.words import (
    blocks,
    count_range,
    differ,
    failures_in_words,
    maps_in_words,
    mean_and_std,
    p_value,
    rate_in_words,
    several_models,
    short,
    signed,
    signed_interval,
    success_interval_in_words,
    unit_of_statistics,
)
from benchnav.eval.stats.best import PRIVILEGED, competing
from benchnav.eval.stats.comparison import ALPHA

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
_RESULTS = ("Succ. [%]", "95 % interval", "T_total [s]", "T if success [s]", "λ̄ [%]")
_PAPER = ("Succ. [%]", "T_total [s]", "λ̄ [%]")
_MOST_ACROSS = 3
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def result_table(summary: pd.DataFrame, conditions: Mapping[str, Mapping[str, Any]]) -> Table:
    """Formats a summary: rates and λ̄ in per cent; bold what is not significantly worse than the best.

    Columns of labels that are the same for all conditions are left out, but for scenario, planner and risk; so
    are the numbers of maps and episodes.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best` and perhaps with latencies.
        conditions: by id what `run.json` knows of them: `follows` and `remarks` become notes.
    """
    labels = [name for name in LABELS if name in _ALWAYS or differ(summary[name])]
    counts = [
        name
        for name in ("groups", "maps", "episodes")
        if summary[f"n_{name}"].nunique() > 1 and (name != "groups" or unit_of_statistics(summary) == "group")
    ]
    times = [heading for heading, name in _TIMES.items() if name in summary and summary[name].notna().any()]
    headings = (*labels, *counts, *_RESULTS, *times, "failures")
    marks, notes = _notes(summary, conditions)
    rows = []
    for row, mark in zip(summary.to_dict("records"), marks, strict=True):
        cells = {name: str(row[name]) for name in labels} | {name: str(row[f"n_{name}"]) for name in counts}
        cells |= {"planner": row["planner"] + mark, **_results(row)}
        if row["best_marked"]:
            cells["Succ. [%]"] = Bold(cells["Succ. [%]"])
        rows.append(tuple(cells[heading] for heading in headings))
    if any("¶" in cell for row in rows for cell in row):
        notes.append("¶ compiled planner: its time is that of compiled code.")
    return Table(
        headings=headings,
        labels=len(labels),
        rows=tuple(rows),
        notes=tuple(notes),
        bold_note=bold_note(summary),
        explained=tuple((heading, _COLUMNS[heading]) for heading in headings),
    )


def paper_table(summary: pd.DataFrame, label: str) -> str:
    """Writes a complete LaTeX table, settings down and blocks across, each with success, T_total and λ̄.

    More than three blocks stand in several tabulars under each other.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best`.
        label: what the table is referred to by.
    """
    known = blocks(summary)
    count = maps_in_words(*(count_range(summary[name]) for name in ("n_maps", "n_groups")))
    note = f" Bold: {bold_note(summary)}" if bold_note(summary) else ""
    caption = (
        f"Planning results on {count} a scenario: success with its 95 % interval, T_total with a failure counted as "
        f"T and mean traversability observed λ̄, mean ± standard deviation over episodes.{note}"
    )
    several = several_models(summary)
    tables = [_across(known[i : i + _MOST_ACROSS], several) for i in range(0, len(known), _MOST_ACROSS)]
    return to_latex(tables, caption, label, wide=len(known) > 1, size="footnotesize")


def _across(known: Sequence[tuple[str, pd.DataFrame]], several: Sequence[str]) -> Table:
    """The table of some blocks, side by side; a label that is the same as over it is left out."""
    labels = ["planner", *several, "risk"]
    side_by_side = []
    for _, rows in known:
        settings = pd.MultiIndex.from_frame(rows[labels])
        side_by_side.append(pd.DataFrame(map(_in_paper, rows.to_dict("records")), settings, dtype=object))
    table = pd.concat(side_by_side, axis=1).fillna(NOT_USED)
    names = table.index.to_frame(index=False)
    names = names.iloc[names["planner"].factorize()[0].argsort(kind="stable")]
    cells = table.loc[pd.MultiIndex.from_frame(names)]
    as_above = names.eq(names.shift()).cummin(axis=1)
    names["planner"] = names["planner"].map(planner_name)
    return Table(
        headings=(*(name.capitalize() for name in labels), *_PAPER * len(known)),
        labels=len(labels),
        rows=tuple(map(tuple, np.hstack([names.mask(as_above, ""), cells]))),
        groups=tuple(title for title, _ in known),
        rules=frozenset(np.flatnonzero(~as_above["planner"])[1:].tolist()),
    )


def _in_paper(row: Mapping[Any, Any]) -> list[str]:
    success = f"{rate_in_words(row)} ({success_interval_in_words(row)})"
    return [
        Bold(success) if row["best_marked"] else success,
        mean_and_std(row["total_time_mean_s"], row["total_time_std_s"]),
        mean_and_std(100 * row["traversability_mean"], 100 * row["traversability_std"]),
    ]


def bold_note(summary: pd.DataFrame) -> str:
    """Says what bold means in a table of a run; nothing where nothing is bold.

    Args:
        summary: as in `result_table`.
    """
    if not summary["best_marked"].any():
        return ""
    words = (
        "not significantly worse than the highest success rate of its block (max-T sign-flip test by "
        f"{unit_of_statistics(summary)} over the block, step by step, p ≥ {ALPHA}); in blocks where nothing is "
        "significantly worse none is marked"
    )
    left_out = pd.concat([rows[~competing(rows)] for _, rows in blocks(summary)])
    models = dict.fromkeys(
        model for part in PRIVILEGED for model in left_out.loc[left_out["privileged"] == part, "model"]
    )
    return f"{words}; privileged models ({', '.join(models)}) do not compete." if models else f"{words}."


def _results(row: Mapping[Any, Any]) -> dict[str, str]:
    met = mean_and_std(100 * row["traversability_mean"], 100 * row["traversability_std"])
    compiled = "¶" if row["compiled_share"] > 0 and not np.isnan(row["planning_ms_median"]) else ""
    # An episode that ended at once met nothing: its λ̄ is of fewer episodes than the row.
    if 0 < row["traversability_n"] < row["n_episodes"]:
        met += f" (n = {row['traversability_n']})"
    total = f"{row['total_time_mean_s']:.1f}"
    if not np.isnan(row["total_time_low_s"]):
        total += f" ({row['total_time_low_s']:.1f}–{row['total_time_high_s']:.1f})"
    return {
        "Succ. [%]": rate_in_words(row),
        "95 % interval": success_interval_in_words(row),
        "T_total [s]": total,
        "T if success [s]": mean_and_std(row["success_time_mean_s"], row["success_time_std_s"]),
        "λ̄ [%]": met,
        ALONE: _times(*(row.get(f"latency_{name}", np.nan) for name in LATENCIES)),
        IN_BATCH: _times(row["planning_ms_median"], row["planning_ms_p95_median"]) + compiled,
        "failures": failures_in_words(row),
    }


def _times(*values: float) -> str:
    """Milliseconds by two digits that count, all but the first in brackets."""
    if np.isnan(values[0]):
        return NOT_USED
    first, *rest = (np.format_float_positional(value, 2, fractional=False, trim="-") for value in values)
    return f"{first} ({', '.join(rest)})"


def _notes(summary: pd.DataFrame, conditions: Mapping[str, Mapping[str, Any]]) -> tuple[list[str], list[str]]:
    """Raised numbers of each condition, and the notes that they refer to; equal texts share a number."""
    numbers: dict[str, str] = {}
    marks = []
    for condition in summary["condition"]:
        about = conditions[condition]
        follows = about["follows"]
        texts = [] if follows in _USERS_OWN else [f"minimises, in place of the task's J: {follows}"]
        own = [
            numbers.setdefault(text, str(len(numbers) + 1).translate(_SUPERSCRIPTS))
            for text in (*texts, *about["remarks"])
        ]
        marks.append(",".join(own))
    return marks, [f"{number} {text}" for text, number in numbers.items()]


def comparison_table(table: pd.DataFrame, difference: float, by: str) -> Table:
    """Formats a comparison: success in percentage points, times in seconds, p after Holm's correction.

    Args:
        table: from `comparison.compare`.
        difference: of success, that `maps_needed` is for.
        by: in what the conditions of a pair differ.
    """
    shown = [name for name in (*LABELS, "run") if name in table and differ(table[name])]
    counts = ["n_maps"] if table["n_maps"].nunique() > 1 else []
    unit = "% of T" if "time_difference_share" in table else "s"
    headings = (
        *(*shown, by, "against"),
        *("maps" for _ in counts),
        *("Succ. [%]", "Δ [points]", "95 %", "p", "significant", "detectable"),
        *(f"Δ T_total [{unit}]", "95 %", "p (ranks)"),
        *("Δ T if both arrive [s]", "95 %", "on maps"),
    )
    rows = []
    for row in table.to_dict("records"):
        labels = [row[name] for name in (*shown, "one", "other")]
        rows.append((*labels, *(str(row[name]) for name in counts), *_differences(row)))
    return Table(
        headings=headings, labels=len(shown) + 2, rows=tuple(rows), notes=_comparison_notes(table, difference)
    )


def _differences(row: Mapping[Any, Any]) -> tuple[str, ...]:
    scale, unit = (100, "share") if "time_difference_share" in row else (1, "s")
    late, low, high = (scale * row[f"time_{value}_{unit}"] for value in ("difference", "low", "high"))
    return (
        f"{short(100 * row['success_one'])} : {short(100 * row['success_other'])}",
        signed(100 * row["success_difference"]),
        signed_interval(100 * row["success_low"], 100 * row["success_high"]),
        p_value(row["success_p_holm"]),
        "yes" if row["success_p_holm"] < ALPHA else "no",
        f"{100 * row['success_detectable']:.0f}" if row["success_detectable"] <= 1 else NOT_USED,
        signed(late),
        signed_interval(low, high),
        p_value(row["time_p_holm"]),
        signed(row["arrival_time_difference_s"]),
        signed_interval(row["arrival_time_low_s"], row["arrival_time_high_s"]),
        str(row["arrival_time_n_maps"]),
    )


def _comparison_notes(table: pd.DataFrame, difference: float) -> tuple[str, ...]:
    pairs = "1 pair" if len(table) == 1 else f"{len(table)} pairs"
    share = (
        " T differs between conditions, so that T_total and its difference are in shares of each condition's own T."
        if "time_difference_share" in table
        else ""
    )
    return (
        f"Family: {pairs}. Holm's correction is over all of them, for success and for T_total apart.",
        "Success: sign-flip test of the difference by map (McNemar's exact test where there is one episode a map), "
        "interval of Bonett and Price. T_total: a failure counts as T; Δ and 95 % are of the mean, "
        "from the intervals of success and of the time without failures." + share,
        "p (ranks): Wilcoxon's signed-rank test of T_total. It compares the ranks of the maps' differences and not "
        "their mean, so that it may disagree with the interval, which is of the mean.",
        "95 %: of each pair alone, not corrected, so that it may leave 0 out where p is above 0.05; of times a dash "
        f"where there are fewer than {LEAST_MAPS} maps.",
        "detectable: minimum detectable difference of success [points], at a power of 80 %; "
        "a dash where they are too few to show any. "
        f"A difference of {100 * difference:g} points needs {count_range(table['maps_needed'])} maps.",
    )
