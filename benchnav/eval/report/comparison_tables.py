"""The tables of a comparison: a row a pair of conditions."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.core.tables import Table
from benchnav.eval.experiment.condition import LABELS, NOT_USED
from benchnav.eval.words import count_range, differ, reading_name
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
    """Write a comparison: success in percentage points, times in seconds, p after
    Holm's correction.

    Args:
        table: from `comparison.compare`.
        difference: of success, that `maps_needed` is for.
        by: in what the conditions of a pair differ.
    """
    scale, stored, unit = (
        (100, "share", "% of T") if "time_difference_share" in table else (1, "s", "s")
    )
    share = (
        "; in shares of each condition's own T, since T differs"
        if stored == "share"
        else ""
    )
    points, times, arrivals = (
        "Δ [points], 95 %",
        f"Δ T_total [{unit}], 95 %",
        "Δ T if both arrive [s], 95 %, on maps",
    )
    columns = [
        Column(
            "Succ. [%]",
            lambda row: (
                f"{short(100 * row['success_one'])} : "
                f"{short(100 * row['success_other'])}"
            ),
            "success rates of the two conditions.",
        ),
        *_difference_columns(
            points,
            "success",
            "",
            100,
            "difference of success, with the interval of Bonett and Price.",
        ),
        Column(
            "p",
            cell_of("success_p_holm", p_value),
            "sign-flip test by map (McNemar's exact test with one episode a map), "
            "Holm's correction.",
        ),
        _significance("success_p_holm"),
        Column(
            "detectable",
            cell_of(
                "success_detectable",
                lambda value: f"{100 * value:.0f}" if value <= 1 else NOT_USED,
            ),
            "minimum detectable difference of success [points] with 80 % power, for "
            "which the maps needed are counted "
            "too; a dash where the maps are too few.",
        ),
        *_difference_columns(
            times,
            "time",
            f"_{stored}",
            scale,
            "difference of the mean time, a failure counted as the time budget "
            f"T{share}; a dash for an interval of "
            f"fewer than {LEAST_MAPS} maps.",
        ),
        Column(
            "p (ranks)",
            cell_of("time_p_holm", p_value),
            "Wilcoxon's signed-rank test of T_total, Holm's correction. It compares "
            "ranks and the interval is of the "
            "mean, so that the two can disagree.",
        ),
        *_difference_columns(
            arrivals,
            "arrival_time",
            "_s",
            1,
            "difference of time over the episodes in which both arrived. It is not "
            "tested: both conditions decide "
            "which episodes these are.",
        ),
        Column("on maps", cell_of("arrival_time_n_maps", str)),
    ]
    return _pair_table(
        table, by, ("n_maps",), columns, _comparison_notes(table, difference)
    )


def metric_table(table: pd.DataFrame, quantity: Quantity, by: str) -> Table:
    """Write a comparison by one metric.

    Args:
        table: from `comparison.compare_by`.
        quantity: what is compared.
        by: in what the conditions of a pair differ.
    """
    unit = f" [{quantity.unit}]" if quantity.unit else ""
    pairs, grouped = _pairs_and_unit(table)
    better = f"; {quantity.better} is better" if quantity.better != "neither" else ""
    over = (
        " Over the episodes in which both reached the goal."
        if quantity.of_arrivals
        else ""
    )

    def values(row: Row) -> str:
        return (
            f"{row['mean_one']:.4g} : {row['mean_other']:.4g}"
            if row["n_episodes"]
            else NOT_USED
        )

    def interval(row: Row) -> str:
        return (
            NOT_USED
            if np.isnan(row["low"])
            else f"{row['low']:+.3g} to {row['high']:+.3g}"
        )

    columns = [
        Column(
            quantity.words + unit,
            values,
            f"{quantity.meaning}, means of the two conditions{better}.{over}",
        ),
        Column(
            f"Δ{unit}",
            lambda row: f"{row['difference']:+.3g}" if row["n_episodes"] else NOT_USED,
            "difference of the means, with its 95 % interval.",
            f"Δ{unit}, 95 %",
        ),
        Column("95 %", interval),
        Column(
            "p",
            cell_of("p_holm", p_value),
            f"sign-flip test by {grouped}, Holm's correction.",
        ),
        _significance("p_holm"),
    ]
    notes = (
        f"Tests by {grouped}: signs of the difference, p corrected over {pairs} "
        "(Holm).",
        "Intervals are of means and not corrected: they can exclude 0 where p > "
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
    """Write columns after those that name a pair: labels that differ, the two that are
    compared, and counts.
    """
    labels = [
        name for name in (*LABELS, "run") if name in table and differ(table[name])
    ]
    named = [
        *(Column(name, cell_of(name, partial(reading_name, name))) for name in labels),
        Column(by, cell_of("one", partial(reading_name, by))),
        Column("against", cell_of("other", partial(reading_name, by))),
    ]
    shown = [
        Column(name.removeprefix("n_"), cell_of(name))
        for name in counts
        if table[name].nunique() > 1
    ]
    rows = table.to_dict("records")
    return table_of(rows, [*named, *shown, *columns], labels=len(named), notes=notes)


def _significance(p: str) -> Column:
    """Return the column that says whether a p-value is significant, by the name of that
    value.
    """
    return Column(
        "significant",
        cell_of(p, lambda value: "yes" if value < ALPHA else "no"),
        f"p < {ALPHA}.",
    )


def _pairs_and_unit(table: pd.DataFrame) -> tuple[str, str]:
    """Return how many pairs were compared, in words, and the unit of the statistics."""
    pairs = "1 pair" if len(table) == 1 else f"{len(table)} pairs"
    return pairs, "group" if (table["n_groups"] < table["n_maps"]).any() else "map"


def _difference_columns(
    title: str, name: str, unit: str, scale: float, meaning: str
) -> list[Column]:
    """Return the columns of a difference and of its interval, of one meaning."""

    def ends(row: Row) -> str:
        return signed_interval(
            scale * row[f"{name}_low{unit}"], scale * row[f"{name}_high{unit}"]
        )

    shown = cell_of(f"{name}_difference{unit}", lambda value: signed(scale * value))
    return [
        Column(title.partition(",")[0], shown, meaning, title),
        Column("95 %", ends),
    ]


def _comparison_notes(table: pd.DataFrame, difference: float) -> tuple[str, ...]:
    pairs, unit = _pairs_and_unit(table)
    needed = (
        f"{100 * difference:g} points need {count_range(table['maps_needed'])} maps."
    )
    if np.isinf(table["success_detectable"]).any():
        needed = (
            f"These {unit}s are too few for any difference to be significant, "
            "and to tell how many it needs."
        )
    return (
        f"Tests by {unit}: signs of the difference (success) and ranks (T_total), p "
        f"corrected over {pairs} (Holm).",
        "Intervals are of means and not corrected: they can exclude 0 where p > "
        f"{ALPHA}. {needed}",
    )
