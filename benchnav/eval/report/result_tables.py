"""The tables of a run: a row a condition, and, for a paper, settings down and scenarios
across.

Source: Endo, Honda and Ishigami (2024), Table I.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.core.tables import Bold, Table, to_latex
from benchnav.eval.experiment.condition import LABELS, NOT_USED
from benchnav.eval.stats.best import PRIVILEGED, competing
from benchnav.eval.words import (
    blocks,
    count_range,
    differ,
    failures_in_words,
    maps_in_words,
    mean_and_std,
    naming_labels,
    rate_in_words,
    reading_name,
    success_interval_in_words,
    unit_of_statistics,
)
from benchnav.metrics import shipped
from benchnav.metrics.base import Metric
from benchnav.stats.best import FEWEST_MAPS
from benchnav.stats.bootstrap import LEAST_MAPS
from benchnav.stats.holm import ALPHA
from benchnav.stats.tables import Column, Row, cell_of, table_of

# What `follows` is where a planner follows the user's objective alone.
_USERS_OWN = ("", "J")
_ALWAYS = ("scenario", "planner", "risk")
_SUCCESS = shipped.SUCCESS.quantity
_TOTAL_TIME = shipped.TOTAL_TIME.quantity
_MET = shipped.TRAVERSABILITY.quantity
ALONE, IN_BATCH = "one robot [ms]", "per episode of a batch [ms]"
LATENCIES = ("median_ms", "p95_ms", "max_ms")
_MEANINGS = {
    "data": "dataset.",
    "scenario": "kind of ground: a test split of the dataset.",
    "world": "behaviour of λ during an episode, and rules of the task.",
    "robot": "motion model of the robot.",
    "objective": "cost J that planners minimise.",
    "model": "predictor of λ; the privileged models ideal, oracle and clairvoyant are "
    "given part of the truth.",
    "sensor": "what a robot sees of its map.",
    "ground": "what a robot senses of λ on its way.",
    "belief": "what is made of what is sensed.",
    "planner": "motion planner.",
    "risk": "risk setting, which turns the predicted distribution of λ into λ̂, the "
    "one number a planner is given.",
    "groups": "number of groups of maps; the group is the statistical unit.",
    "maps": "number of maps.",
    "episodes": "number of episodes.",
}
_PAPER = (_SUCCESS.heading, _TOTAL_TIME.heading, _MET.heading)
_MOST_ACROSS = 3
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def _success(row: Row) -> str:
    rate = rate_in_words(row)
    return Bold(rate) if row["best_marked"] else rate


def _total_time(row: Row) -> str:
    mean = f"{row['total_time_mean_s']:.1f}"
    if np.isnan(row["total_time_low_s"]):
        return mean
    return f"{mean} ({row['total_time_low_s']:.1f}–{row['total_time_high_s']:.1f})"


def _met(row: Row) -> str:
    met = mean_and_std(
        100 * row["traversability_mean"], 100 * row["traversability_std"]
    )
    # An episode that ended at once met nothing: its λ̄ is of fewer episodes than the
    # row.
    some = 0 < row["traversability_n"] < row["n_episodes"]
    return f"{met} (n = {row['traversability_n']})" if some else met


def _planning_time(row: Row) -> str:
    compiled = (
        "¶"
        if row["compiled_share"] > 0 and not np.isnan(row["planning_ms_median"])
        else ""
    )
    return _times(row["planning_ms_median"], row["planning_ms_p95_median"]) + compiled


_RESULTS = (
    Column(_SUCCESS.heading, _success, f"{_SUCCESS.meaning}."),
    Column(
        "95 % interval",
        success_interval_in_words,
        "Wilson's interval of the success rate, with maps as the unit.",
    ),
    Column(
        _TOTAL_TIME.heading,
        _total_time,
        f"mean {_TOTAL_TIME.meaning}, with its 95 % interval in brackets; no interval "
        f"under {LEAST_MAPS} maps.",
    ),
    Column(
        "T if success [s]",
        lambda row: mean_and_std(row["success_time_mean_s"], row["success_time_std_s"]),
        "time of the episodes that reached the goal, mean ± standard deviation.",
    ),
    Column(
        _MET.heading, _met, f"{_MET.meaning}, mean ± standard deviation over episodes."
    ),
)
# Of the columns that not every run has, that of the summary which says so.
_TIMES = {
    "latency_median_ms": Column(
        ALONE,
        lambda row: _times(*(row[f"latency_{name}"] for name in LATENCIES)),
        "planning time of a step of one robot alone, on one thread: median (95th "
        "percentile, maximum) over at most "
        "100 steps.",
    ),
    "planning_ms_median": Column(
        IN_BATCH,
        _planning_time,
        "planning time of a step of a batch, divided by its episodes, on one thread: "
        "median (95th percentile) over "
        "steps; no latency.",
    ),
}
_FAILURES = Column("failures", failures_in_words, "how the other episodes ended.")


def result_table(
    summary: pd.DataFrame,
    conditions: Mapping[str, Mapping[str, Any]],
    further: Sequence[Quantity] = (),
) -> Table:
    """Formats a summary: rates and λ̄ in per cent; bold what is not significantly worse
    than the best.

    Columns of labels that are the same for all conditions are left out, but for
    scenario, planner and risk; so are the numbers of maps and episodes.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best` and perhaps
            with latencies.
        conditions: by id what `run.json` knows of them: `follows` and `remarks` become
            notes.
        further: quantities that the run has besides those of every run, a column each.
    """
    marks, notes = _notes(summary, conditions)
    labels = _label_columns(summary, _ALWAYS)
    counts = [
        Column(name, cell_of(f"n_{name}"), _MEANINGS[name])
        for name in ("groups", "maps", "episodes")
        if summary[f"n_{name}"].nunique() > 1
        and (name != "groups" or unit_of_statistics(summary) == "group")
    ]
    times = [
        column
        for name, column in _TIMES.items()
        if name in summary and summary[name].notna().any()
    ]
    columns = [
        *labels,
        *counts,
        *_RESULTS,
        *map(_further_column, further),
        *times,
        _FAILURES,
    ]
    rows = summary.assign(mark=marks).to_dict("records")
    if any(column.cell(row).endswith("¶") for column in times for row in rows):
        notes.append("¶ The planner ran as compiled code.")
    if (summary["best_rivals"] > 0).any() and not summary["best_marked"].any():
        few = summary["best_maps"].max() < FEWEST_MAPS
        why = (
            f"with fewer than {FEWEST_MAPS} {unit_of_statistics(summary)}s none can "
            "be called"
            if few
            else "no setting is significantly"
        )
        notes.append(f"No rate is bold: {why} worse than the best.")
    return table_of(
        rows,
        columns,
        labels=len(labels),
        notes=tuple(notes),
        bold_note=bold_note(summary),
    )


def _label_columns(summary: pd.DataFrame, always: Collection[str]) -> list[Column]:
    """Return the columns of labels that differ and of those that always stand there; a
    planner has its mark.
    """
    return [
        Column(name, partial(_label, name), _MEANINGS[name])
        for name in LABELS
        if name in always or differ(summary[name])
    ]


def _label(name: str, row: Row) -> str:
    mark = row.get("mark", "") if name == "planner" else ""
    return reading_name(name, str(row[name])) + mark


def _further_column(quantity: Quantity) -> Column:
    meaning = (
        f"{quantity.meaning}: mean over episodes, with its 95 % interval in brackets; "
        f"no interval under {LEAST_MAPS} "
        "maps; n is the number of episodes that have it, if not all have."
    )
    return Column(quantity.heading, partial(_mean_in_words, quantity), meaning)


def _mean_in_words(quantity: Quantity, row: Row) -> str:
    """The mean of a further quantity with its interval, in the quantity's unit."""
    mean, low, high = (
        quantity.scale * row[quantity.summary_column(name)]
        for name in ("mean", "low", "high")
    )
    if np.isnan(mean):
        return NOT_USED
    count = row[f"{quantity.column.removesuffix(quantity.suffix)}_n"]
    words = f"{mean:.4g}" if np.isnan(low) else f"{mean:.4g} ({low:.4g}–{high:.4g})"
    return f"{words} (n = {count})" if count < row["n_episodes"] else words


def learning_table(summary: pd.DataFrame) -> Table | None:
    """What the robots of each condition learnt on their way; None where none learnt.

    Args:
        summary: from `summary.summarise`.
    """
    if summary.empty or summary["revisions_mean"].isna().all():
        return None
    rows = summary[summary["revisions_mean"].notna()].to_dict("records")
    full = {
        _but_sensor(row): row
        for row in summary.to_dict("records")
        if row["sensor"] == "full"
    }
    labels = _label_columns(summary, (*_ALWAYS, "ground", "belief"))
    columns = [
        *labels,
        *(
            _mean_column(metric, "{:.0f}".format)
            for metric in (shipped.SEEN_CELLS, shipped.SENSED_CELLS, shipped.REVISIONS)
        ),
        *(_mean_column(metric, _number) for metric in shipped.AHEAD),
        _mean_column(shipped.LEARNING_TIME, _times),
        Column(
            "planning [ms]",
            cell_of("planning_ms_median", _times),
            "time of a step for planning, likewise: median over steps.",
        ),
    ]
    if any(row["sensor"] != "full" and _but_sensor(row) in full for row in rows):
        columns += [
            Column(
                "Succ. to full [points]",
                lambda row: _lost(row, full, "success_rate", 100),
                "success less that of the same condition with the sensor `full`; "
                "`compare --by sensor --against full` has the interval and the test.",
            ),
            Column(
                "T_total to full [s]",
                lambda row: _lost(row, full, "total_time_mean_s", 1),
                "mean T_total less that of the same condition with the sensor `full`.",
            ),
        ]
    return table_of(
        rows, columns, labels=len(labels), title="What robots learnt on their way"
    )


def _mean_column(metric: Metric, write: Callable[[Any], str]) -> Column:
    cell = cell_of(metric.quantity.summary_column("mean"), write)
    return Column(
        metric.quantity.heading, cell, f"{metric.meaning}, mean over episodes."
    )


def _but_sensor(row: Row) -> tuple[str, ...]:
    """What a condition is beside its sensor of appearance."""
    return tuple(str(row[name]) for name in LABELS if name != "sensor")


def _lost(
    row: Row, full: Mapping[tuple[str, ...], Row], name: str, scale: float
) -> str:
    """A value less that of a robot that sees all."""
    reference = full.get(_but_sensor(row))
    if reference is None or row["sensor"] == "full":
        return NOT_USED
    return f"{scale * (row[name] - reference[name]):+.1f}"


def paper_table(summary: pd.DataFrame, label: str, mark: str = "") -> str:
    """Writes a complete LaTeX table, settings down and blocks across, each with
    success, T_total and λ̄.

    More than three blocks stand in several tabulars under each other.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best`.
        label: what the table is referred to by.
        mark: words that the caption begins with.
    """
    known = blocks(summary)
    count = maps_in_words(
        *(count_range(summary[name]) for name in ("n_maps", "n_groups"))
    )
    note = f" Bold: {bold_note(summary)}" if bold_note(summary) else ""
    caption = (
        f"{mark}Planning results on {count} per scenario: success rate with its 95 % "
        "interval; total time T_total, a "
        "failure counted as the time budget T; and mean observed traversability λ̄. "
        "± is the standard deviation over "
        f"episodes.{note}"
    )
    several = naming_labels(summary)
    tables = [
        _across(known[i : i + _MOST_ACROSS], several)
        for i in range(0, len(known), _MOST_ACROSS)
    ]
    return to_latex(tables, caption, label, wide=len(known) > 1, size="footnotesize")


def _across(known: Sequence[tuple[str, pd.DataFrame]], several: Sequence[str]) -> Table:
    """The table of some blocks, side by side; a label that is the same as over it is
    left out.
    """
    labels = ["planner", *several, "risk"]
    side_by_side = []
    for _, rows in known:
        settings = pd.MultiIndex.from_frame(rows[labels])
        side_by_side.append(
            pd.DataFrame(
                map(_in_paper, rows.to_dict("records")), settings, dtype=object
            )
        )
    table = pd.concat(side_by_side, axis=1).fillna(NOT_USED)
    names = table.index.to_frame(index=False)
    names = names.iloc[names["planner"].factorize()[0].argsort(kind="stable")]
    cells = table.loc[pd.MultiIndex.from_frame(names)]
    as_above = names.eq(names.shift()).cummin(axis=1)
    for name in labels:
        names[name] = [reading_name(name, label) for label in names[name]]
    return Table(
        headings=(
            *(name.capitalize() for name in labels),
            *(_SUCCESS.heading, _TOTAL_TIME.heading, _MET.heading) * len(known),
        ),
        labels=len(labels),
        rows=tuple(map(tuple, np.hstack([names.mask(as_above, ""), cells]))),
        groups=tuple(title for title, _ in known),
        rules=frozenset(np.flatnonzero(~as_above["planner"])[1:].tolist()),
    )


def _in_paper(row: Row) -> list[str]:
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
        f"highest success rate{several} and all without a significant difference from "
        "it (max-T bootstrap test by "
        f"{unit_of_statistics(summary)}, p ≥ {ALPHA})"
    )
    left_out = pd.concat([rows[~competing(rows)] for _, rows in blocks(summary)])
    models = dict.fromkeys(
        model
        for part in PRIVILEGED
        for model in left_out.loc[left_out["privileged"] == part, "model"]
    )
    return (
        f"{words}. Privileged models ({', '.join(models)}) do not compete."
        if models
        else f"{words}."
    )


def _number(value: float) -> str:
    return NOT_USED if np.isnan(value) else f"{value:.3f}"


def _times(*values: float) -> str:
    """Milliseconds by two digits that count, all but the first in brackets."""
    if np.isnan(values[0]):
        return NOT_USED
    first, *rest = (
        np.format_float_positional(value, 2, fractional=False, trim="-")
        for value in values
    )
    return f"{first} ({', '.join(rest)})" if rest else first


def _notes(
    summary: pd.DataFrame, conditions: Mapping[str, Mapping[str, Any]]
) -> tuple[list[str], list[str]]:
    """Raised numbers of each condition, and the notes that they refer to; equal texts
    share a number.
    """
    numbers: dict[str, str] = {}
    marks = []
    for condition in summary["condition"]:
        about = conditions[condition]
        follows = about["follows"]
        texts = (
            []
            if follows in _USERS_OWN
            else [f"Cost minimised in place of J: {follows}."]
        )
        own = [
            numbers.setdefault(text, str(len(numbers) + 1).translate(_SUPERSCRIPTS))
            for text in (*texts, *about["remarks"])
        ]
        marks.append(",".join(own))
    return marks, [f"{number} {text}" for text, number in numbers.items()]
