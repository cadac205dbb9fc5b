"""The tables of a run: a row a condition, and, for a paper, settings down and scenarios across; and of a comparison.

Source of the first two: Endo, Honda and Ishigami (2024), Table I.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.tables import Bold, Table, to_latex
from benchnav.eval.experiment.condition import LABELS, NOT_USED
from benchnav.eval.stats.best import FEWEST_MAPS, PRIVILEGED, competing
from benchnav.eval.stats.comparison import ALPHA
from benchnav.eval.words import (
    blocks,
    count_range,
    differ,
    failures_in_words,
    maps_in_words,
    mean_and_std,
    naming_labels,
    p_value,
    rate_in_words,
    reading_name,
    short,
    signed,
    signed_interval,
    success_interval_in_words,
    unit_of_statistics,
)

# What `follows` is where a planner follows the user's objective alone.
_USERS_OWN = ("", "J")
_ALWAYS = ("scenario", "planner", "risk")
ALONE, IN_BATCH = "one robot [ms]", "per episode of a batch [ms]"
LATENCIES = ("median_ms", "p95_ms", "max_ms")
# What columns hold, by heading; only those that are shown are explained.
_COLUMNS = {
    "data": "dataset.",
    "scenario": "kind of ground: a test split of the dataset.",
    "world": "behaviour of λ during an episode, and rules of the task.",
    "robot": "motion model of the robot.",
    "objective": "cost J that planners minimise.",
    "model": "predictor of λ; the privileged models ideal, oracle and clairvoyant are given part of the truth.",
    "sensor": "what a robot sees of its map.",
    "ground": "what a robot senses of λ on its way.",
    "belief": "what is made of what is sensed.",
    "planner": "motion planner.",
    "risk": "risk setting, which turns the predicted distribution of λ into λ̂, the one number a planner is given.",
    "groups": "number of groups of maps; the group is the statistical unit.",
    "maps": "number of maps.",
    "episodes": "number of episodes.",
    "Succ. [%]": "share of episodes that reached the goal.",
    "95 % interval": "Wilson's interval of the success rate, with maps as the unit.",
    "T_total [s]": "mean time to the goal, a failure counted as the time budget T, with its 95 % interval in brackets; "
    f"no interval under {FEWEST_MAPS} maps.",
    "T if success [s]": "time of the episodes that reached the goal, mean ± standard deviation.",
    "λ̄ [%]": "mean observed λ of an episode, mean ± standard deviation over episodes.",
    ALONE: "planning time of a step of one robot alone, on one thread: median (95th percentile, maximum) over at most "
    "100 steps.",
    IN_BATCH: "planning time of a step of a batch, divided by its episodes, on one thread: median (95th percentile) "
    "over steps; no latency.",
    "failures": "how the other episodes ended.",
}
# Of the columns that not every run has, that of the summary which says so.
_TIMES = {ALONE: "latency_median_ms", IN_BATCH: "planning_ms_median"}
_RESULTS = ("Succ. [%]", "95 % interval", "T_total [s]", "T if success [s]", "λ̄ [%]")
_PAPER = ("Succ. [%]", "T_total [s]", "λ̄ [%]")
_LEARNT = {
    "cells seen": "cells whose appearance a robot saw, mean over episodes.",
    "cells sensed": "cells whose λ it sensed, mean over episodes.",
    "revisions": "how often its planner was given another map, mean over episodes.",
    "RMSE ahead": "root mean square error of the believed E[λ] over the cells ahead of the robot of which λ was not "
    "sensed, mean over updates and episodes.",
    "log score ahead": "mean log score of the belief over these cells, at least −10 a cell; higher is better.",
    "belief [ms]": "time of a step for sensing and belief, of a batch divided by its episodes.",
    "planning [ms]": "time of a step for planning, likewise: median over steps.",
}
_TO_FULL = {
    "Succ. to full [points]": "success less that of the same condition with the sensor `full`; "
    "`compare --by sensor --against full` has the interval and the test.",
    "T_total to full [s]": "mean T_total less that of the same condition with the sensor `full`.",
}
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
        cells = {name: reading_name(name, str(row[name])) for name in labels}
        cells |= {name: str(row[f"n_{name}"]) for name in counts}
        cells |= {"planner": cells["planner"] + mark, **_results(row)}
        if row["best_marked"]:
            cells["Succ. [%]"] = Bold(cells["Succ. [%]"])
        rows.append(tuple(cells[heading] for heading in headings))
    if any("¶" in cell for row in rows for cell in row):
        notes.append("¶ The planner ran as compiled code.")
    if (summary["best_rivals"] > 0).any() and not summary["best_marked"].any():
        few = summary["best_maps"].max() < FEWEST_MAPS
        why = (
            f"with fewer than {FEWEST_MAPS} {unit_of_statistics(summary)}s none can be called"
            if few
            else "no setting is significantly"
        )
        notes.append(f"No rate is bold: {why} worse than the best.")
    return Table(
        headings=headings,
        labels=len(labels),
        rows=tuple(rows),
        notes=tuple(notes),
        bold_note=bold_note(summary),
        explained=tuple((heading, _COLUMNS[heading]) for heading in headings),
    )


def learning_table(summary: pd.DataFrame) -> Table | None:
    """What the robots of each condition learnt on their way; None where none learnt.

    Args:
        summary: from `summary.summarise`.
    """
    if summary.empty or summary["revisions_mean"].isna().all():
        return None
    learnt = summary[summary["revisions_mean"].notna()]
    labels = [name for name in LABELS if name in (*_ALWAYS, "ground", "belief") or differ(summary[name])]
    full = {_but_sensor(row): row for row in summary.to_dict("records") if row["sensor"] == "full"}
    partly = [row for row in learnt.to_dict("records") if row["sensor"] != "full"]
    compared = any(_but_sensor(row) in full for row in partly)
    rows = [
        (
            *(reading_name(name, str(row[name])) for name in labels),
            *(f"{row[f'{name}_mean']:.0f}" for name in ("seen_cells", "sensed_cells", "revisions")),
            *(_number(row[f"{name}_mean"]) for name in ("ahead_rmse", "ahead_log_score")),
            *(_times(row[name]) for name in ("learning_ms_mean", "planning_ms_median")),
            *(_lost(row, full.get(_but_sensor(row))) if compared else ()),
        )
        for row in learnt.to_dict("records")
    ]
    explained = {name: _COLUMNS[name] for name in labels} | _LEARNT | (_TO_FULL if compared else {})
    return Table(
        headings=tuple(explained),
        labels=len(labels),
        rows=tuple(rows),
        explained=tuple(explained.items()),
        title="What robots learnt on their way",
    )


def _but_sensor(row: Mapping[Any, Any]) -> tuple[str, ...]:
    """What a condition is beside its sensor of appearance."""
    return tuple(str(row[name]) for name in LABELS if name != "sensor")


def _lost(row: Mapping[Any, Any], full: Mapping[Any, Any] | None) -> tuple[str, str]:
    """Success in points and T_total in seconds, less those of a robot that sees all."""
    if full is None or row["sensor"] == "full":
        return NOT_USED, NOT_USED
    success = 100 * (row["success_rate"] - full["success_rate"])
    return f"{success:+.1f}", f"{row['total_time_mean_s'] - full['total_time_mean_s']:+.1f}"


def paper_table(summary: pd.DataFrame, label: str, mark: str = "") -> str:
    """Writes a complete LaTeX table, settings down and blocks across, each with success, T_total and λ̄.

    More than three blocks stand in several tabulars under each other.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best`.
        label: what the table is referred to by.
        mark: words that the caption begins with.
    """
    known = blocks(summary)
    count = maps_in_words(*(count_range(summary[name]) for name in ("n_maps", "n_groups")))
    note = f" Bold: {bold_note(summary)}" if bold_note(summary) else ""
    caption = (
        f"{mark}Planning results on {count} per scenario: success rate with its 95 % interval; total time T_total, a "
        f"failure counted as the time budget T; and mean observed traversability λ̄. ± is the standard deviation over "
        f"episodes.{note}"
    )
    several = naming_labels(summary)
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
    for name in labels:
        names[name] = [reading_name(name, label) for label in names[name]]
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
    several = "" if len(blocks(summary)) == 1 else " of a block"
    words = (
        f"highest success rate{several} and all without a significant difference from it (max-T bootstrap test by "
        f"{unit_of_statistics(summary)}, p ≥ {ALPHA})"
    )
    left_out = pd.concat([rows[~competing(rows)] for _, rows in blocks(summary)])
    models = dict.fromkeys(
        model for part in PRIVILEGED for model in left_out.loc[left_out["privileged"] == part, "model"]
    )
    return f"{words}. Privileged models ({', '.join(models)}) do not compete." if models else f"{words}."


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


def _number(value: float) -> str:
    return NOT_USED if np.isnan(value) else f"{value:.3f}"


def _times(*values: float) -> str:
    """Milliseconds by two digits that count, all but the first in brackets."""
    if np.isnan(values[0]):
        return NOT_USED
    first, *rest = (np.format_float_positional(value, 2, fractional=False, trim="-") for value in values)
    return f"{first} ({', '.join(rest)})" if rest else first


def _notes(summary: pd.DataFrame, conditions: Mapping[str, Mapping[str, Any]]) -> tuple[list[str], list[str]]:
    """Raised numbers of each condition, and the notes that they refer to; equal texts share a number."""
    numbers: dict[str, str] = {}
    marks = []
    for condition in summary["condition"]:
        about = conditions[condition]
        follows = about["follows"]
        texts = [] if follows in _USERS_OWN else [f"Cost minimised in place of J: {follows}."]
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
        labels = [reading_name(name, row[name]) for name in shown]
        labels += [reading_name(by, row[name]) for name in ("one", "other")]
        rows.append((*labels, *(str(row[name]) for name in counts), *_differences(row)))
    return Table(
        headings=headings,
        labels=len(shown) + 2,
        rows=tuple(rows),
        notes=_comparison_notes(table, difference),
        explained=_comparison_columns(unit),
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
    unit = "group" if (table["n_groups"] < table["n_maps"]).any() else "map"
    needed = f"{100 * difference:g} points need {count_range(table['maps_needed'])} maps."
    if np.isinf(table["success_detectable"]).any():
        needed = (
            f"These {unit}s are too few for any difference to be significant, and to tell how many it needs."
        )
    return (
        f"Tests by {unit}: signs of the difference (success) and ranks (T_total), p corrected over {pairs} (Holm).",
        f"Intervals are of means and not corrected: they can exclude 0 where p > {ALPHA}. {needed}",
    )


def _comparison_columns(unit: str) -> tuple[tuple[str, str], ...]:
    share = "; in shares of each condition's own T, since T differs" if unit != "s" else ""
    return (
        ("Succ. [%]", "success rates of the two conditions."),
        ("Δ [points], 95 %", "difference of success, with the interval of Bonett and Price."),
        ("p", "sign-flip test by map (McNemar's exact test with one episode a map), Holm's correction."),
        ("significant", f"p < {ALPHA}."),
        (
            "detectable",
            "minimum detectable difference of success [points] with 80 % power, for which the maps needed are counted "
            "too; a dash where the maps are too few.",
        ),
        (
            f"Δ T_total [{unit}], 95 %",
            f"difference of the mean time, a failure counted as the time budget T{share}; a dash for an interval of "
            f"fewer than {FEWEST_MAPS} maps.",
        ),
        (
            "p (ranks)",
            "Wilcoxon's signed-rank test of T_total, Holm's correction. It compares ranks and the interval is of the "
            "mean, so that the two can disagree.",
        ),
        (
            "Δ T if both arrive [s], 95 %, on maps",
            "difference of time over the episodes in which both arrived. It is not tested: both conditions decide "
            "which episodes these are.",
        ),
    )
