"""Scores of several contestants on the same maps: intervals, differences of each pair
with a test, and the best.

A score is any function of sums over maps, so one way serves means, roots, ratios and
distances alike. The map is the unit, or the group of maps where a dataset has groups:

- an interval is that of the bootstrap by percentiles, over maps in an order that their
  sums decide;
- a test exchanges the two contestants on each map (`flips.exchange_p`);
- Holm's correction is over all pairs of contestants that compete, within a score.

Letters in shapes: M maps; C columns of a sum, such as classes, else 1.
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
    """A number that follows from sums over maps.

    Args:
        name: of its columns.
        parts: names of the sums that it is computed from.
        of: their function, of one argument a part, each of shape [..., C]: values,
            shape [...].
        better: whether higher or lower values are better; empty if neither is.
        target: the value whose distance is compared, lower being better; None if the
            score itself is.
        heading: of its column in tables, in two lines.
        meaning: what the column holds.
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
        """Return what is compared: the values, or their distance to the target."""
        return values if self.target is None else abs(values - self.target)

    def value(self, sums: Sums) -> float:
        """Return the score over all maps."""
        table, of = self.split(sums)
        return float(of(table.sum(0)))

    def split(
        self, sums: Sums
    ) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        """Return the parts by map in one table, shape [M, P], and the score of their
        sums, [..., P] to [...].
        """
        columns = [sums[part].reshape(len(sums[part]), -1) for part in self.parts]
        ends = np.cumsum([part.shape[1] for part in columns])[:-1]

        def of(totals: np.ndarray) -> np.ndarray:
            with np.errstate(divide="ignore", invalid="ignore"):
                return self.of(*np.split(totals, ends, axis=-1))

        return np.hstack(columns), of


def summarise(scores: Sequence[Score], sums: Mapping[str, Sums]) -> pd.DataFrame:
    """Compute the scores of each contestant.

    Args:
        scores: which.
        sums: by contestant and part, over M maps, shape [M] or [M, C].

    Returns:
        A row a contestant: `units`, M; and of each score that its sums have `NAME` and
        its 95 % interval `NAME_low`, `NAME_high`, NaN under `bootstrap.LEAST_MAPS`
        maps.
    """
    rows = {}
    for contestant, own in sums.items():
        row: dict[str, float] = {"units": len(next(iter(own.values())))}
        for score in _known(scores, own):
            table, of = score.split(own)
            low, high = _bootstrap(table[np.lexsort(table.T)], of)
            row |= {
                score.name: float(of(table.sum(0))),
                f"{score.name}_low": low,
                f"{score.name}_high": high,
            }
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
        scores: what is compared.
        sums: as in `summarise`, of the same M maps each.
        competing: the contestants whose pairs Holm's correction is over.
        same: name of a sum, such as a number of cells, in which the maps of two must
            agree.

    Returns:
        A row a pair and score: `measure`, its name; `one`, `other`; `difference` of
        what is judged, `one` less `other`, with its 95 % interval `low`, `high`; `p`;
        and, of competing contestants only, `p_holm`. Pairs that lack the score or
        differ in `same` are left out.
    """
    found = []
    for one, other in combinations(sums, 2):
        if not np.array_equal(sums[one][same], sums[other][same]):
            continue
        for score in _known(scores, sums[one], sums[other]):
            if row := _compare(score, sums[one], sums[other]):
                found.append({"measure": score.name, "one": one, "other": other, **row})
    table = pd.DataFrame(found, columns=_PAIR).astype(dict.fromkeys(_PAIR[3:], float))
    rivals = table[table["one"].isin(competing) & table["other"].isin(competing)]
    for _, rows in rivals.groupby("measure"):
        table.loc[rows.index, "p_holm"] = holm(rows["p"].to_numpy())
    return table


def _compare(score: Score, one: Sums, other: Sums) -> dict[str, float]:
    table, of = score.split(one)
    other_table, _ = score.split(other)

    def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return score.judged(of(a)) - score.judged(of(b))

    observed = float(difference(table.sum(0), other_table.sum(0)))
    if not np.isfinite(observed):
        return {}
    both = np.hstack([table, other_table])
    order = _order_of_pairs(table, other_table)
    low, high = _bootstrap(
        both[order], lambda sums: difference(*np.split(sums, 2, axis=-1))
    )
    return {
        "difference": observed,
        "low": low,
        "high": high,
        "p": exchange_p(table, other_table, difference),
    }


def _known(scores: Sequence[Score], *sums: Sums) -> list[Score]:
    return [
        score
        for score in scores
        if all(part in own for part in score.parts for own in sums)
    ]


def _bootstrap(
    table: np.ndarray, of: Callable[[np.ndarray], np.ndarray]
) -> tuple[float, float]:
    """Return the ends of the interval of a function of sums over maps."""
    if len(table) < LEAST_MAPS:
        return np.nan, np.nan
    return percentile_interval(of(bootstrap_counts(len(table)) @ table))


def _order_of_pairs(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return an order of maps that stays the same when the two change places."""
    keys = [np.hstack([one + other, gap]) for gap in (one - other, other - one)]
    orders = [np.lexsort(key.T) for key in keys]
    first, second = (
        key[order].ravel().tolist() for key, order in zip(keys, orders, strict=True)
    )
    return orders[first > second]


def against_best(
    scores: Sequence[Score], summary: pd.DataFrame, pairs: pd.DataFrame
) -> pd.DataFrame:
    """Find the best contestant by each score, and which are significantly worse.

    Args:
        scores: which; those that have no better way have no best.
        summary: rows from `summarise` of the contestants that compete.
        pairs: from `compare_pairs`.

    Returns:
        Rows by contestant, one for each score that it has: `measure`, `best`; of all
        but the best `difference`, the contestant less the best, `low`, `high`, `p_holm`
        as from `compare_pairs`; `alike`, true if it is not significantly worse; and
        `marked`, true if it is alike and another contestant is not.
    """
    swapped = pairs.assign(
        one=pairs["other"],
        other=pairs["one"],
        difference=-pairs["difference"],
        low=-pairs["high"],
        high=-pairs["low"],
    )
    both = pd.concat([pairs, swapped])
    found = []
    for score in scores:
        if score.name not in summary or not (score.better or score.target is not None):
            continue
        values = score.judged(summary[score.name].dropna())
        if values.empty:
            continue
        loss = -values if score.better == "higher" else values
        best = loss.sort_index().idxmin()  # of equal ones the first by name
        rows = both[(both["measure"] == score.name) & (both["other"] == best)]
        rows = rows.set_index("one")[list(_TO_BEST)].reindex(loss.index)
        alike = ~(rows["p_holm"] < ALPHA)
        found.append(
            rows.assign(
                measure=score.name, best=best, alike=alike, marked=alike & ~alike.all()
            )
        )
    return pd.concat(found)
