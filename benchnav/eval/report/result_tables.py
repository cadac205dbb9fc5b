"""Tables of a run: one row per condition; for a paper, columns for each block.

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
    display_name,
    failures_in_words,
    maps_in_words,
    mean_and_std,
    naming_labels,
    rate_in_words,
    success_interval_in_words,
    unit_of_statistics,
)
from benchnav.metrics import shipped
from benchnav.metrics.base import Metric
from benchnav.stats.best import FEWEST_MAPS
from benchnav.stats.bootstrap import LEAST_MAPS
from benchnav.stats.holm import ALPHA
from benchnav.stats.tables import Column, Row, cell_of, table_of

# Values of `follows` for planners that minimise only the objective J.
_ONLY_J = ("", "J")
_ALWAYS = ("scenario", "planner", "risk")  # columns of labels that are always shown
_SUCCESS = shipped.SUCCESS.quantity
_TOTAL_TIME = shipped.TOTAL_TIME.quantity
_TRAVERSABILITY = shipped.TRAVERSABILITY.quantity
ALONE = "one robot [ms]"
IN_BATCH = "per episode of a batch [ms]"
LATENCIES = ("median_ms", "p95_ms", "max_ms")
_MEANINGS = {
    "data": "dataset.",
    "scenario": "kind of terrain: a test split of the dataset.",
    "world": "behaviour of λ during an episode, and rules of the task.",
    "robot": "motion model of the robot.",
    "objective": "cost J that planners minimise.",
    "model": "predictor of λ; the privileged models ideal, oracle and clairvoyant are "
    "given part of the truth.",
    "sensor": "appearance sensor: the observed part of the map.",
    "ground": "traversability sensor: the measured λ.",
    "belief": "update of the prediction by measurements.",
    "planner": "motion planner.",
    "risk": "risk setting, which turns the predicted distribution of λ into λ̂, the "
    "value that a planner is given.",
    "groups": "number of groups of maps; the group is the statistical unit.",
    "maps": "number of maps.",
    "episodes": "number of episodes.",
}
# Headings of the columns of a block in the table for a paper.
_PAPER_HEADINGS = (_SUCCESS.heading, _TOTAL_TIME.heading, _TRAVERSABILITY.heading)
_MAX_ACROSS = 3  # blocks side by side
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def _success(row: Row) -> str:
    rate = rate_in_words(row)
    return Bold(rate) if row["best_marked"] else rate


def _total_time(row: Row) -> str:
    mean = f"{row['total_time_mean_s']:.1f}"
    low = row["total_time_low_s"]
    if np.isnan(low):
        return mean
    return f"{mean} ({low:.1f}–{row['total_time_high_s']:.1f})"


def _success_time(row: Row) -> str:
    return mean_and_std(row["success_time_mean_s"], row["success_time_std_s"])


def _traversability(row: Row) -> str:
    mean = 100 * row["traversability_mean"]
    text = mean_and_std(mean, 100 * row["traversability_std"])
    # An episode without a step has no observed λ, and thus no λ̄.
    count = row["traversability_n"]
    is_partial = 0 < count < row["n_episodes"]
    return f"{text} (n = {count})" if is_partial else text


def _latency(row: Row) -> str:
    return _times(*(row[f"latency_{name}"] for name in LATENCIES))


def _planning_time(row: Row) -> str:
    median = row["planning_ms_median"]
    is_compiled = row["compiled_share"] > 0 and not np.isnan(median)
    times = _times(median, row["planning_ms_p95_median"])
    return f"{times}¶" if is_compiled else times


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
        f"mean {_TOTAL_TIME.meaning}. In brackets: its 95 % interval, with "
        f"{LEAST_MAPS} maps or more.",
    ),
    Column(
        "T if success [s]",
        _success_time,
        "time of the episodes that reached the goal, mean ± standard deviation.",
    ),
    Column(
        _TRAVERSABILITY.heading,
        _traversability,
        f"{_TRAVERSABILITY.meaning}, mean ± standard deviation over episodes.",
    ),
)
# Optional columns, by the required column of the summary.
_TIMES = {
    "latency_median_ms": Column(
        ALONE,
        _latency,
        "planning time of a step of one robot without a batch, on one thread: median "
        "(95th percentile, maximum) over at most 100 steps.",
    ),
    "planning_ms_median": Column(
        IN_BATCH,
        _planning_time,
        "planning time of a step of a batch, divided by its number of episodes, on one "
        "thread: median (95th percentile) over steps; not a latency.",
    ),
}
_FAILURES = Column("failures", failures_in_words, "outcomes of the other episodes.")


def result_table(
    summary: pd.DataFrame,
    conditions: Mapping[str, Mapping[str, Any]],
    further: Sequence[Quantity] = (),
) -> Table:
    """Format a summary; rates not significantly below the best are bold.

    Columns with the same value for all conditions are left out: labels, except
    scenario, planner and risk; and numbers of maps and episodes.

    Args:
        summary: table from `summary.summarise`, joined with `best.against_best`, and
            with latencies if they were measured.
        conditions: entries of `run.json` by id; `follows` and `remarks` become notes.
        further: quantities in addition to the built-in ones; each has a column.
    """
    marks, notes = _notes(summary, conditions)
    labels = _label_columns(summary, _ALWAYS)
    times = []
    for name, column in _TIMES.items():
        if name in summary and summary[name].notna().any():
            times.append(column)
    results = [*_RESULTS, *map(_further_column, further), *times, _FAILURES]
    columns = [*labels, *_count_columns(summary), *results]
    rows = summary.assign(mark=marks).to_dict("records")
    if any(column.cell(row).endswith("¶") for column in times for row in rows):
        notes.append("¶ The planner ran as compiled code.")
    has_rivals = (summary["best_rivals"] > 0).any()
    if has_rivals and not summary["best_marked"].any():
        reason = "no setting is significantly"
        if summary["best_maps"].max() < FEWEST_MAPS:
            unit = unit_of_statistics(summary)
            reason = f"with fewer than {FEWEST_MAPS} {unit}s, no setting can be called"
        notes.append(f"No rate is bold: {reason} worse than the best.")
    return table_of(
        rows,
        columns,
        n_labels=len(labels),
        notes=tuple(notes),
        bold_note=bold_note(summary),
    )


def _count_columns(summary: pd.DataFrame) -> list[Column]:
    """Return the columns of those numbers of maps and episodes that differ."""
    names = ["maps", "episodes"]
    if unit_of_statistics(summary) == "group":
        names.insert(0, "groups")
    columns = []
    for name in names:
        count = f"n_{name}"
        if summary[count].nunique() > 1:
            columns.append(Column(name, cell_of(count), _MEANINGS[name]))
    return columns


def _label_columns(summary: pd.DataFrame, always: Collection[str]) -> list[Column]:
    """Return the columns of labels that differ or are always shown."""
    return [
        Column(name, partial(_label, name), _MEANINGS[name])
        for name in LABELS
        if name in always or differ(summary[name])
    ]


def _label(name: str, row: Row) -> str:
    mark = row.get("mark", "") if name == "planner" else ""
    return display_name(name, str(row[name])) + mark


def _further_column(quantity: Quantity) -> Column:
    meaning = (
        f"{quantity.meaning}: mean over episodes, with its 95 % interval in brackets "
        f"if there are {LEAST_MAPS} maps or more; n is the number of episodes with a "
        "value, if some have no value."
    )
    return Column(quantity.heading, partial(_mean_in_words, quantity), meaning)


def _mean_in_words(quantity: Quantity, row: Row) -> str:
    """Return the mean of a quantity with its interval, in the quantity's unit."""
    columns = map(quantity.summary_column, ("mean", "low", "high"))
    mean, low, high = (quantity.scale * row[column] for column in columns)
    if np.isnan(mean):
        return NOT_USED
    words = f"{mean:.4g}"
    if not np.isnan(low):
        words += f" ({low:.4g}–{high:.4g})"
    stem = quantity.column.removesuffix(quantity.suffix)
    count = row[f"{stem}_n"]
    return f"{words} (n = {count})" if count < row["n_episodes"] else words


def learning_table(summary: pd.DataFrame) -> Table | None:
    """Return the table of learning during episodes; None if no robot learnt.

    Args:
        summary: table from `summary.summarise`.
    """
    if summary.empty or summary["revisions_mean"].isna().all():
        return None
    has_learnt = summary["revisions_mean"].notna()
    rows = summary[has_learnt].to_dict("records")
    labels = _label_columns(summary, (*_ALWAYS, "ground", "belief"))
    counts = (shipped.SEEN_CELLS, shipped.SENSED_CELLS, shipped.REVISIONS)
    columns = [
        *labels,
        *(_mean_column(metric, "{:.0f}".format) for metric in counts),
        *(_mean_column(metric, _number) for metric in shipped.AHEAD),
        _mean_column(shipped.LEARNING_TIME, _times),
        Column(
            "planning [ms]",
            cell_of("planning_ms_median", _times),
            "planning time of a step of a batch, divided by its number of episodes: "
            "median over steps.",
        ),
    ]
    columns += _columns_to_full(rows, summary)
    return table_of(
        rows, columns, n_labels=len(labels), title="Learning during episodes"
    )


def _mean_column(metric: Metric, write: Callable[[Any], str]) -> Column:
    quantity = metric.quantity
    cell = cell_of(quantity.summary_column("mean"), write)
    return Column(quantity.heading, cell, f"{metric.meaning}, mean over episodes.")


def _columns_to_full(rows: Sequence[Row], summary: pd.DataFrame) -> list[Column]:
    """Return columns of differences from the same condition with sensor `full`."""
    is_full = summary["sensor"] == "full"
    full = {_without_sensor(row): row for row in summary[is_full].to_dict("records")}

    def reference(row: Row) -> Row | None:
        return None if row["sensor"] == "full" else full.get(_without_sensor(row))

    def difference(row: Row, name: str, scale: float) -> str:
        with_full = reference(row)
        if with_full is None:
            return NOT_USED
        return f"{scale * (row[name] - with_full[name]):+.1f}"

    if all(reference(row) is None for row in rows):
        return []
    return [
        Column(
            "Succ. to full [points]",
            partial(difference, name="success_rate", scale=100),
            "success minus that of the same condition with the sensor `full`; "
            "`compare --by sensor --against full` has the interval and the test.",
        ),
        Column(
            "T_total to full [s]",
            partial(difference, name="total_time_mean_s", scale=1),
            "mean T_total minus that of the same condition with the sensor `full`.",
        ),
    ]


def _without_sensor(row: Row) -> tuple[str, ...]:
    """Return the labels of a condition except its appearance sensor."""
    return tuple(str(row[name]) for name in LABELS if name != "sensor")


def paper_table(summary: pd.DataFrame, label: str, mark: str = "") -> str:
    """Return a complete LaTeX table: one row per setting, and columns for each block.

    The columns are success, T_total and λ̄. More than three blocks are split over
    several tabulars.

    Args:
        summary: table from `summary.summarise`, joined with `best.against_best`.
        label: LaTeX label of the table.
        mark: start of the caption.
    """
    all_blocks = blocks(summary)
    maps = count_range(summary["n_maps"])
    groups = count_range(summary["n_groups"])
    bold = bold_note(summary)
    note = f" Bold: {bold}" if bold else ""
    caption = (
        f"{mark}Planning results on {maps_in_words(maps, groups)} per scenario: "
        "success rate with its 95 % interval; total time T_total, where a failure "
        "counts as the time budget T; and mean observed traversability λ̄. "
        f"± is the standard deviation over episodes.{note}"
    )
    several = naming_labels(summary)
    tables = []
    for first in range(0, len(all_blocks), _MAX_ACROSS):
        side_by_side = all_blocks[first : first + _MAX_ACROSS]
        tables.append(_across(side_by_side, several))
    is_wide = len(all_blocks) > 1
    return to_latex(tables, caption, label, wide=is_wide, size="footnotesize")


def _across(
    shown_blocks: Sequence[tuple[str, pd.DataFrame]], several: Sequence[str]
) -> Table:
    """Return a table of blocks side by side, with repeated labels left empty."""
    labels = ["planner", *several, "risk"]
    side_by_side = []
    for _, rows in shown_blocks:
        settings = pd.MultiIndex.from_frame(rows[labels])
        cells = map(_in_paper, rows.to_dict("records"))
        side_by_side.append(pd.DataFrame(cells, settings, dtype=object))
    table = pd.concat(side_by_side, axis=1).fillna(NOT_USED)
    names = table.index.to_frame(index=False)
    planner, _ = names["planner"].factorize()
    names = names.iloc[planner.argsort(kind="stable")]
    cells = table.loc[pd.MultiIndex.from_frame(names)]
    is_as_above = names.eq(names.shift()).cummin(axis=1)
    starts_planner = ~is_as_above["planner"]
    for name in labels:
        names[name] = [display_name(name, label) for label in names[name]]
    shown_names = names.mask(is_as_above, "")
    label_headings = [name.capitalize() for name in labels]
    return Table(
        headings=(*label_headings, *_PAPER_HEADINGS * len(shown_blocks)),
        n_labels=len(labels),
        rows=tuple(map(tuple, np.hstack([shown_names, cells]))),
        groups=tuple(title for title, _ in shown_blocks),
        rules=frozenset(np.flatnonzero(starts_planner)[1:].tolist()),
    )


def _in_paper(row: Row) -> list[str]:
    success = f"{rate_in_words(row)} ({success_interval_in_words(row)})"
    if row["best_marked"]:
        success = Bold(success)
    total_time = mean_and_std(row["total_time_mean_s"], row["total_time_std_s"])
    mean = 100 * row["traversability_mean"]
    traversability = mean_and_std(mean, 100 * row["traversability_std"])
    return [success, total_time, traversability]


def bold_note(summary: pd.DataFrame) -> str:
    """Return the meaning of bold in a table of a run; empty if nothing is bold.

    Args:
        summary: as in `result_table`.
    """
    if not summary["best_marked"].any():
        return ""
    all_blocks = blocks(summary)
    scope = "" if len(all_blocks) == 1 else " of a block"
    words = (
        f"the highest success rate{scope}, and all rates without a significant "
        "difference from it (max-T bootstrap test by "
        f"{unit_of_statistics(summary)}, p ≥ {ALPHA})"
    )
    left_out = pd.concat([rows[~competing(rows)] for _, rows in all_blocks])
    models: dict[str, None] = {}
    for part in PRIVILEGED:
        labels = left_out.loc[left_out["privileged"] == part, "model"]
        models |= dict.fromkeys(labels)
    if not models:
        return f"{words}."
    return f"{words}. Privileged models ({', '.join(models)}) do not compete."


def _number(value: float) -> str:
    return NOT_USED if np.isnan(value) else f"{value:.3f}"


def _times(*values: float) -> str:
    """Format times with two significant digits; put all but the first in brackets."""
    if np.isnan(values[0]):
        return NOT_USED
    digits = partial(
        np.format_float_positional, precision=2, fractional=False, trim="-"
    )
    first, *others = map(digits, values)
    return f"{first} ({', '.join(others)})" if others else first


def _notes(
    summary: pd.DataFrame, conditions: Mapping[str, Mapping[str, Any]]
) -> tuple[list[str], list[str]]:
    """Return the numbers of notes of each condition, and all notes, numbered."""
    numbers: dict[str, str] = {}
    marks = []
    for condition in summary["condition"]:
        entry = conditions[condition]
        texts = [*entry["remarks"]]
        cost = entry["follows"]
        if cost not in _ONLY_J:
            texts.insert(0, f"Cost minimised instead of J: {cost}.")
        for text in texts:
            next_number = str(len(numbers) + 1).translate(_SUPERSCRIPTS)
            numbers.setdefault(text, next_number)
        marks.append(",".join(numbers[text] for text in texts))
    return marks, [f"{number} {text}" for text, number in numbers.items()]
