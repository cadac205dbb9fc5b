"""The tables of a comparison: a row a pair of conditions."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.core.tables import Table
from benchnav.eval.experiment.condition import LABELS, NOT_USED
from benchnav.eval.report.words import (
    count_range,
    differ,
    p_value,
    reading_name,
    short,
    signed,
    signed_interval,
)
from benchnav.eval.stats.best import FEWEST_MAPS
from benchnav.eval.stats.comparison import ALPHA


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


def metric_table(table: pd.DataFrame, quantity: Quantity, by: str) -> Table:
    """Formats a comparison by one metric.

    Args:
        table: from `by_metric.compare_by`.
        quantity: what is compared.
        by: in what the conditions of a pair differ.
    """
    shown = [name for name in (*LABELS, "run") if name in table and differ(table[name])]
    counts = [name for name in ("n_maps", "n_episodes") if table[name].nunique() > 1]
    unit = f" [{quantity.unit}]" if quantity.unit else ""
    headings = (
        *(*shown, by, "against"),
        *(name.removeprefix("n_") for name in counts),
        *(quantity.words + unit, f"Δ{unit}", "95 %", "p", "significant"),
    )
    rows = []
    for row in table.to_dict("records"):
        labels = [reading_name(name, row[name]) for name in shown]
        labels += [reading_name(by, row[name]) for name in ("one", "other")]
        values = [f"{row[name]:.4g}" for name in ("mean_one", "mean_other")]
        interval = NOT_USED if np.isnan(row["low"]) else f"{row['low']:+.3g} to {row['high']:+.3g}"
        rows.append(
            (
                *labels,
                *(str(row[name]) for name in counts),
                " : ".join(values) if row["n_episodes"] else NOT_USED,
                f"{row['difference']:+.3g}" if row["n_episodes"] else NOT_USED,
                interval,
                p_value(row["p_holm"]),
                "yes" if row["p_holm"] < ALPHA else "no",
            )
        )
    pairs = "1 pair" if len(table) == 1 else f"{len(table)} pairs"
    grouped = "group" if (table["n_groups"] < table["n_maps"]).any() else "map"
    better = f"; {quantity.better} is better" if quantity.better != "neither" else ""
    over = " Over the episodes in which both reached the goal." if quantity.of_arrivals else ""
    return Table(
        headings=headings,
        labels=len(shown) + 2,
        rows=tuple(rows),
        notes=(
            f"Tests by {grouped}: signs of the difference, p corrected over {pairs} (Holm).",
            f"Intervals are of means and not corrected: they can exclude 0 where p > {ALPHA}.",
        ),
        explained=(
            (quantity.words + unit, f"{quantity.meaning}, means of the two conditions{better}.{over}"),
            (f"Δ{unit}, 95 %", "difference of the means, with its 95 % interval."),
            ("p", f"sign-flip test by {grouped}, Holm's correction."),
            ("significant", f"p < {ALPHA}."),
        ),
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
