"""The table of a comparison, formatted, with what has to be known to read it."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from benchnav.core.tables import Table
from benchnav.eval.experiment.condition import LABELS, NOT_USED
from benchnav.eval.report.words import count_range, differ, p_value, short, signed, signed_interval
from benchnav.eval.stats.comparison import ALPHA
from benchnav.eval.stats.paired_difference import LEAST_MAPS

_LABELS = (*LABELS, "run")


def comparison_table(table: pd.DataFrame, difference: float, by: str) -> Table:
    """Formats a comparison: success in percentage points, times in seconds, p after Holm's correction.

    Args:
        table: from `comparison.compare`.
        difference: of success, that `maps_needed` is for.
        by: in what the conditions of a pair differ.
    """
    shown = [name for name in _LABELS if name in table and differ(table[name])]
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
        rows.append((*labels, *(str(row[name]) for name in counts), *_results(row)))
    return Table(headings=headings, labels=len(shown) + 2, rows=tuple(rows), notes=_notes(table, difference))


def _results(row: Mapping[Any, Any]) -> tuple[str, ...]:
    names = [f"time_{value}_share" for value in ("difference", "low", "high")]
    late = [100 * row[name] if name in row else row[f"{name.removesuffix('share')}s"] for name in names]
    return (
        f"{short(100 * row['success_one'])} : {short(100 * row['success_other'])}",
        signed(100 * row["success_difference"]),
        signed_interval(100 * row["success_low"], 100 * row["success_high"]),
        p_value(row["success_p_holm"]),
        "yes" if row["success_p_holm"] < ALPHA else "no",
        f"{100 * row['success_detectable']:.0f}" if row["success_detectable"] <= 1 else NOT_USED,
        signed(late[0]),
        signed_interval(*late[1:]),
        p_value(row["time_p_holm"]),
        signed(row["arrival_time_difference_s"]),
        signed_interval(row["arrival_time_low_s"], row["arrival_time_high_s"]),
        str(row["arrival_time_n_maps"]),
    )


def _notes(table: pd.DataFrame, difference: float) -> tuple[str, ...]:
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
