"""Scores of several contestants on the same maps: intervals, paired tests, the best.

A score is any function of sums over maps, such as a mean, root, ratio or distance. The
statistical unit is the map, or the group of maps if a dataset has groups.

- Intervals are percentile bootstrap intervals over maps. Maps are sorted by their sums,
  so that an interval does not depend on the order of maps.
- Tests exchange the two contestants on each map (`flips.exchange_p`).
- For each score, Holm's correction covers all pairs of competing contestants.

Letters in shapes: M maps; C columns of a sum, such as classes, or 1; P columns of all
sums of a score.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np
import pandas as pd

from benchnav.stats.bootstrap import LEAST_MAPS, bootstrap_counts, percentile_interval
from benchnav.stats.flips import exchange_p
from benchnav.stats.holm import ALPHA, holm

Sums = Mapping[str, np.ndarray]

_PAIR = ("measure", "one", "other", "difference", "low", "high", "p", "p_holm")
_TO_BEST = ("difference", "low", "high", "p_holm")


@dataclass(frozen=True, kw_only=True)
class Score:
    """A function of sums over maps.

    Args:
        name: name of the score's columns.
        parts: names of the sums from which the score is computed.
        of: function of these sums, each of shape [..., C], that returns the score,
            shape [...].
        better: better direction; empty if no direction is better.
        target: ideal value of the score. Contestants are then compared by the distance
            of their scores to this value, and a lower distance is better. If None, they
            are compared by the scores themselves.
        heading: heading of the score's column in tables, in two lines.
        meaning: definition of the column's values.
    """

    name: str
    parts: tuple[str, ...]
    of: Callable[..., np.ndarray]
    better: Literal["", "higher", "lower"] = ""
    target: float | None = None
    heading: str = ""
    meaning: str = ""

    @property
    def title(self) -> str:
        """The heading in one line."""
        return " ".join(self.heading.split())

    def judged(self, values: Any) -> Any:
        """Return the compared quantity: the values, or their distance to the target."""
        if self.target is None:
            return values
        return abs(values - self.target)

    def value(self, sums: Sums) -> float:
        """Return the score over all maps."""
        table, of = self.split(sums)
        return float(of(table.sum(0)))

    def split(
        self, sums: Sums
    ) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        """Return the score's sums by map as a table, and the score as a function.

        The table has shape [M, P]. The function takes its sums over maps, of shape
        [..., P], and returns scores of shape [...].
        """
        columns = []
        for part in self.parts:
            values = sums[part]
            columns.append(values.reshape(len(values), -1))
        widths = [column.shape[1] for column in columns]
        ends = np.cumsum(widths)[:-1]

        def of(totals: np.ndarray) -> np.ndarray:
            parts = np.split(totals, ends, axis=-1)
            with np.errstate(divide="ignore", invalid="ignore"):
                return self.of(*parts)

        return np.hstack(columns), of


def summarise(scores: Sequence[Score], sums: Mapping[str, Sums]) -> pd.DataFrame:
    """Compute the scores of each contestant.

    Args:
        scores: scores to compute.
        sums: sums by contestant and name, with one value per map, each of shape [M] or
            [M, C].

    Returns:
        One row per contestant: `units`, the number of maps M; and for each score whose
        parts the contestant has, `NAME`, with the limits `NAME_low` and `NAME_high` of
        its 95 % interval. The interval is NaN if there are fewer than
        `bootstrap.LEAST_MAPS` maps.
    """
    rows = {}
    for contestant, contestant_sums in sums.items():
        first_part = next(iter(contestant_sums.values()))
        row: dict[str, float] = {"units": len(first_part)}
        for score in _defined(scores, contestant_sums):
            table, of = score.split(contestant_sums)
            order = np.lexsort(table.T)
            low, high = _bootstrap(table[order], of)
            row[score.name] = float(of(table.sum(0)))
            row[f"{score.name}_low"] = low
            row[f"{score.name}_high"] = high
        rows[contestant] = row
    return pd.DataFrame.from_dict(rows, orient="index")


def compare_pairs(
    scores: Sequence[Score],
    sums: Mapping[str, Sums],
    competing: Sequence[str],
    same: str,
) -> pd.DataFrame:
    """Compare all pairs of contestants, map by map.

    Args:
        scores: scores to compare.
        sums: sums by contestant and name, as in `summarise`, over the same M maps.
        competing: contestants whose pairs are covered by Holm's correction.
        same: name of a sum that must be equal for both contestants of a pair on all
            maps, such as the number of cells.

    Returns:
        One row per pair and score: `measure`, the score's name; `one` and `other`, the
        contestants; `difference` of the compared quantity (`one` minus `other`), with
        the limits `low` and `high` of its 95 % interval; `p`; and `p_holm`, which is
        NaN unless both contestants compete. Pairs without the score, or with different
        values of `same`, are omitted.
    """
    records = []
    for first, second in combinations(sums, 2):
        first_sums = sums[first]
        second_sums = sums[second]
        if not np.array_equal(first_sums[same], second_sums[same]):
            continue
        for score in _defined(scores, first_sums, second_sums):
            if row := _compare(score, first_sums, second_sums):
                labels = {"measure": score.name, "one": first, "other": second}
                records.append({**labels, **row})
    table = pd.DataFrame(records, columns=_PAIR)
    table = table.astype(dict.fromkeys(_PAIR[3:], float))
    is_competing = table["one"].isin(competing) & table["other"].isin(competing)
    for _, rows in table[is_competing].groupby("measure"):
        table.loc[rows.index, "p_holm"] = holm(rows["p"].to_numpy())
    return table


def _compare(score: Score, first: Sums, second: Sums) -> dict[str, float]:
    first_table, of = score.split(first)
    second_table, _ = score.split(second)

    def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return score.judged(of(a)) - score.judged(of(b))

    def difference_of_halves(sums: np.ndarray) -> np.ndarray:
        a, b = np.split(sums, 2, axis=-1)
        return difference(a, b)

    observed = float(difference(first_table.sum(0), second_table.sum(0)))
    if not np.isfinite(observed):
        return {}
    paired = np.hstack([first_table, second_table])
    order = _order_of_pairs(first_table, second_table)
    low, high = _bootstrap(paired[order], difference_of_halves)
    p = exchange_p(first_table, second_table, difference)
    return {"difference": observed, "low": low, "high": high, "p": p}


def _defined(scores: Sequence[Score], *sums: Sums) -> list[Score]:
    """Return the scores whose parts are in all of `sums`, one mapping per contestant."""
    names = set.intersection(*(set(parts) for parts in sums))
    return [score for score in scores if names.issuperset(score.parts)]


def _bootstrap(
    table: np.ndarray, of: Callable[[np.ndarray], np.ndarray]
) -> tuple[float, float]:
    """Return the ends of the bootstrap interval of a function of sums over maps."""
    if len(table) < LEAST_MAPS:
        return np.nan, np.nan
    sums = bootstrap_counts(len(table)) @ table
    return percentile_interval(of(sums))


def _order_of_pairs(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return an order of maps that stays the same if the contestants are swapped."""
    total = first + second
    key = np.hstack([total, first - second])
    swapped_key = np.hstack([total, second - first])
    order = np.lexsort(key.T)
    swapped_order = np.lexsort(swapped_key.T)
    values = key[order].ravel().tolist()
    swapped_values = swapped_key[swapped_order].ravel().tolist()
    return swapped_order if values > swapped_values else order


def against_best(
    scores: Sequence[Score], summary: pd.DataFrame, pairs: pd.DataFrame
) -> pd.DataFrame:
    """Find the best contestant by each score, and those that are significantly worse.

    Args:
        scores: scores to use; a score without a better direction is skipped.
        summary: rows from `summarise` of the competing contestants.
        pairs: rows from `compare_pairs`.

    Returns:
        One row per contestant and score: `measure`, the score's name; `best`, the best
        contestant; `difference` from the best contestant, with `low`, `high` and
        `p_holm` as in `compare_pairs`, all NaN in the row of the best contestant;
        `alike`, true if the contestant is not significantly worse; and `marked`, true
        if it is `alike` and another contestant is not.
    """
    swapped = pairs.assign(
        one=pairs["other"],
        other=pairs["one"],
        difference=-pairs["difference"],
        low=-pairs["high"],
        high=-pairs["low"],
    )
    ordered = pd.concat([pairs, swapped])
    tables = []
    for score in scores:
        has_best = score.better or score.target is not None
        if score.name not in summary or not has_best:
            continue
        values = score.judged(summary[score.name].dropna())
        if values.empty:
            continue
        loss = -values if score.better == "higher" else values
        best = loss.sort_index().idxmin()  # of equal contestants, the first by name
        is_to_best = (ordered["measure"] == score.name) & (ordered["other"] == best)
        rows = ordered[is_to_best].set_index("one")
        rows = rows[list(_TO_BEST)].reindex(loss.index)
        alike = ~(rows["p_holm"] < ALPHA)
        marked = alike & ~alike.all()
        table = rows.assign(measure=score.name, best=best, alike=alike, marked=marked)
        tables.append(table)
    return pd.concat(tables)
