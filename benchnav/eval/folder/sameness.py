"""Whether two tables of episodes hold the same results, bit for bit.

Columns of wall time, which begin with `planning_`, and the digest of the code are no results.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

KEYS = ["condition", "seed", "realisation", "map"]
_TIMING = "planning_"


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One episode that is not the same in two tables.

    Args:
        episode: the condition's id, seed, realisation and map.
        columns: by name what the first and the second table hold; empty where one has no such episode.
    """

    episode: tuple[str, int, int, int]
    columns: Mapping[str, tuple[object, object]]


def differing_columns(first: pd.DataFrame, second: pd.DataFrame) -> list[str]:
    """Columns of results that only one of two tables has."""
    return sorted(set(_results(first)) ^ set(_results(second)))


def differences(first: pd.DataFrame, second: pd.DataFrame) -> list[Difference]:
    """Episodes that differ between two tables, in the order of the first; those that one lacks at the end.

    Args:
        first: rows of episodes, in any order.
        second: as well; columns that only one has are not compared.
    """
    columns = [name for name in _results(first) if name in second]
    one, other = first.set_index(KEYS)[columns], second.set_index(KEYS)[columns]
    both = one.index.intersection(other.index, sort=False)
    mine, theirs = one.loc[both], other.loc[both]
    unlike = {name: _unlike(mine[name], theirs[name]) for name in columns}
    any_unlike = np.logical_or.reduce(list(unlike.values())) if columns else np.zeros(len(both), bool)
    found = []
    for row in np.flatnonzero(any_unlike):
        values = {
            name: (mine[name].iloc[row], theirs[name].iloc[row]) for name in columns if unlike[name][row]
        }
        found.append(Difference(episode=both[row], columns=values))
    lacking = [*one.index.difference(both, sort=False), *other.index.difference(both, sort=False)]
    return found + [Difference(episode=episode, columns={}) for episode in lacking]


def _results(rows: pd.DataFrame) -> list[str]:
    return [name for name in rows.columns if name not in (*KEYS, "code") and not name.startswith(_TIMING)]


def _unlike(one: pd.Series, other: pd.Series) -> np.ndarray:
    missing = one.isna().to_numpy(), other.isna().to_numpy()
    return (one.to_numpy() != other.to_numpy()) & ~(missing[0] & missing[1])
