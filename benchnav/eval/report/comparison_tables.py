"""The tables of a comparison: one row per pair of conditions."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.core.tables import Table
from benchnav.eval.experiment.condition import LABELS, NOT_USED
from benchnav.eval.words import count_range, differ, display_name
from benchnav.stats.bootstrap import LEAST_MAPS
from benchnav.stats.holm import ALPHA
from benchnav.stats.tables import (
    Column,
    Row,
    cell_of,
    p_value,
    short,
    signed,
    signed_interval,
    table_of,
)


def comparison_table(table: pd.DataFrame, difference: float, by: str) -> Table:
    """Format a comparison of success and T_total.

    Args:
        table: table from `comparison.compare`.
        difference: difference in success rate, as a fraction, for which `maps_needed`
            was computed.
        by: column in which the conditions of a pair differ.
    """
    scale, suffix, unit, fraction_note = 1, "s", "s", ""
    if "time_difference_share" in table:
        scale, suffix, unit = 100, "share", "% of T"
        fraction_note = "; in fractions of each condition's own T, since T differs"

    def success_rates(row: Row) -> str:
        rates = [short(100 * row[f"success_{side}"]) for side in ("one", "other")]
        return " : ".join(rates)

    def detectable(value: float) -> str:
        return f"{100 * value:.0f}" if value <= 1 else NOT_USED

    columns = [
        Column("Succ. [%]", success_rates, "success rates of the two conditions."),
        *_difference_columns(
            "Δ [points], 95 %",
            "success",
            "",
            100,
            "difference of success, with the interval of Bonett and Price.",
        ),
        Column(
            "p",
            cell_of("success_p_holm", p_value),
            "sign-flip test per map (McNemar's exact test with one episode a map), "
            "Holm's correction.",
        ),
        _significance("success_p_holm"),
        Column(
            "detectable",
            cell_of("success_detectable", detectable),
            "minimum detectable difference of success [points] at a power of 80 %, "
            "as for the number of maps needed; a dash if there are too few maps.",
        ),
        *_difference_columns(
            f"Δ T_total [{unit}], 95 %",
            "time",
            f"_{suffix}",
            scale,
            "difference of the mean time, where a failure counts as the time budget "
            f"T{fraction_note}; below {LEAST_MAPS} maps, a dash instead of an interval.",
        ),
        Column(
            "p (ranks)",
            cell_of("time_p_holm", p_value),
            "Wilcoxon's signed-rank test of T_total, Holm's correction. The test is of "
            "ranks and the interval of the mean, so the two can disagree.",
        ),
        *_difference_columns(
            "Δ T if both arrive [s], 95 %, on maps",
            "arrival_time",
            "_s",
            1,
            "difference of time over the episodes in which both reached the goal. It "
            "is not tested, since both conditions select these episodes.",
        ),
        Column("on maps", cell_of("arrival_time_n_maps", str)),
    ]
    notes = _comparison_notes(table, difference)
    return _pair_table(table, by, ("n_maps",), columns, notes)


def metric_table(table: pd.DataFrame, quantity: Quantity, by: str) -> Table:
    """Format a comparison by one metric.

    Args:
        table: table from `comparison.compare_by`.
        quantity: the compared quantity.
        by: column in which the conditions of a pair differ.
    """
    unit = f" [{quantity.unit}]" if quantity.unit else ""
    pairs, grouped = _pairs_and_unit(table)
    better = f"; {quantity.better} is better" if quantity.better != "neither" else ""
    over = ""
    if quantity.of_arrivals:
        over = " Over the episodes in which both reached the goal."

    def values(row: Row) -> str:
        if not row["n_episodes"]:
            return NOT_USED
        return f"{row['mean_one']:.4g} : {row['mean_other']:.4g}"

    def interval(row: Row) -> str:
        if np.isnan(row["low"]):
            return NOT_USED
        return f"{row['low']:+.3g} to {row['high']:+.3g}"

    def difference(row: Row) -> str:
        return f"{row['difference']:+.3g}" if row["n_episodes"] else NOT_USED

    columns = [
        Column(
            quantity.words + unit,
            values,
            f"{quantity.meaning}, means of the two conditions{better}.{over}",
        ),
        Column(
            f"Δ{unit}",
            difference,
            "difference of the means, with its 95 % interval.",
            f"Δ{unit}, 95 %",
        ),
        Column("95 %", interval),
        Column(
            "p",
            cell_of("p_holm", p_value),
            f"sign-flip test per {grouped}, Holm's correction.",
        ),
        _significance("p_holm"),
    ]
    notes = (
        f"Tests by {grouped}: signs of the difference, p corrected over {pairs} "
        "(Holm).",
        "Intervals are for means and not corrected: they can exclude 0 although p > "
        f"{ALPHA}.",
    )
    return _pair_table(table, by, ("n_maps", "n_episodes"), columns, notes)


def _pair_table(
    table: pd.DataFrame,
    by: str,
    counts: Sequence[str],
    columns: Sequence[Column],
    notes: tuple[str, ...],
) -> Table:
    """Format a table with the labels that differ, both labels of a pair, and columns.

    Args:
        table: table of the comparison.
        by: column in which the conditions of a pair differ.
        counts: columns of counts, which are shown only if they differ between pairs.
        columns: further columns.
        notes: notes of the table.
    """
    names = [name for name in (*LABELS, "run") if name in table]
    labels = []
    for name in names:
        if differ(table[name]):
            label = partial(display_name, name)
            labels.append(Column(name, cell_of(name, label)))
    label = partial(display_name, by)
    labels.append(Column(by, cell_of("one", label)))
    labels.append(Column("against", cell_of("other", label)))
    shown_counts = []
    for name in counts:
        if table[name].nunique() > 1:
            shown_counts.append(Column(name.removeprefix("n_"), cell_of(name)))
    rows = table.to_dict("records")
    all_columns = [*labels, *shown_counts, *columns]
    return table_of(rows, all_columns, n_labels=len(labels), notes=notes)


def _significance(p: str) -> Column:
    """Return the column that shows whether the p-values in column `p` are significant."""
    return Column(
        "significant",
        cell_of(p, lambda value: "yes" if value < ALPHA else "no"),
        f"p < {ALPHA}.",
    )


def _pairs_and_unit(table: pd.DataFrame) -> tuple[str, str]:
    """Return the number of pairs in words, and the name of the statistical unit."""
    pairs = "1 pair" if len(table) == 1 else f"{len(table)} pairs"
    has_groups = (table["n_groups"] < table["n_maps"]).any()
    return pairs, "group" if has_groups else "map"


def _difference_columns(
    title: str, name: str, unit: str, scale: float, meaning: str
) -> list[Column]:
    """Return two columns: a difference, and its interval.

    Args:
        title: heading of both columns together, in explanations.
        name: start of the names of columns in the comparison, such as `time`.
        unit: end of these names, such as `_s`.
        scale: factor from the stored values to the shown values.
        meaning: explanation of the columns.
    """

    def interval(row: Row) -> str:
        low = scale * row[f"{name}_low{unit}"]
        high = scale * row[f"{name}_high{unit}"]
        return signed_interval(low, high)

    heading, _, _ = title.partition(",")
    shown = cell_of(f"{name}_difference{unit}", lambda value: signed(scale * value))
    return [Column(heading, shown, meaning, title), Column("95 %", interval)]


def _comparison_notes(table: pd.DataFrame, difference: float) -> tuple[str, ...]:
    pairs, unit = _pairs_and_unit(table)
    needed = (
        f"{100 * difference:g} points need {count_range(table['maps_needed'])} maps."
    )
    if np.isinf(table["success_detectable"]).any():
        needed = (
            f"There are too few {unit}s for a significant difference, and for an "
            "estimate of the number of maps needed."
        )
    return (
        f"Tests by {unit}: signs of the difference (success) and ranks (T_total), p "
        f"corrected over {pairs} (Holm).",
        "Intervals are for means and not corrected: they can exclude 0 although p > "
        f"{ALPHA}. {needed}",
    )
