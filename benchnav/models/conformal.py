"""Conformal recalibration: lower quantiles that keep what they promise on a new map of
the same kind.

Maps that no part of a model has seen give scores: the PIT values s = F(λ) of their
cells, drawn within the jump where λ has an atom. Cells of one map are alike, so maps
are the unit: each counts the same, whatever its cells, and one more map counts as if
all of its scores were 0. With n maps, and G_j(t) the share of the scores of map j
that are under t,

    t(u) = sup {t : (G_1(t) + … + G_n(t) + 1) / (n + 1) ≤ u},    Q_conf(u) = Q(t(u)).

**Promise.** Let these maps and a new one be exchangeable, and the model be made without
them. Then for a random cell of the new map, at every level u of the table, P(λ <
Q_conf(u)) ≤ u; in between, at most the next level. Why: let t* be the supremum of t
with (G_1(t) + … + G_{n+1}(t)) / (n + 1) ≤ u, the new map included. G_{n+1} ≤ 1, so t(u)
≤ t*. The maps are exchangeable in t*, so P(s < t*) for a cell of the new map is the
expected mean of G_j(t*) over all maps, which is at most u. And λ < Q(t) means F(λ) < t,
hence s < t.

The promise holds on average over new maps and over the choice of the calibration maps.
It is of one side, of quantiles
and not of CVaR, and of no other ground: not of hg or hs. Its price is 1 / (n + 1) of
probability that moves to the lowest λ.
Sources: Dunn, Wasserman and Ramdas (2022), "Distribution-free prediction sets for
two-layer hierarchical models" (pooling CDFs); Lee, Barber and Willett (2023),
"Distribution-free inference with hierarchical data" (the new group's weight). Letters
in shapes: H×W cells, *B any leading dimensions, N cells of a map.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy import ndarray

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import CheckpointError, expect
from benchnav.core.quantiles import LEVELS, QuantileDistribution, quantiles_at
from benchnav.core.terrain import Observation
from benchnav.models.base import TraversabilityModel

_ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True)
class ConformalTable:
    """At which level of its own a model has the quantile that it is to promise.

    Args:
        levels: u, ascending from 0 to 1.
        values: t(u) in [0, 1], which do not descend.
        maps: n, how many maps gave the scores.
    """

    levels: tuple[float, ...]
    values: tuple[float, ...]
    maps: int

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """Reads what `plain` has written.

        Raises:
            CheckpointError: it is no such table.
        """
        try:
            levels, values = (
                tuple(map(float, data[name])) for name in ("levels", "values")
            )
            table = cls(levels=levels, values=values, maps=int(data["maps"]))
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"Expected a table of `conformal`, got {type(error).__name__} {error}."
            ) from error
        ascends = all(low <= high for low, high in pairwise((0.0, *values, 1.0)))
        if len(levels) != len(values) or not ascends:
            raise CheckpointError(
                "Expected `conformal` with values in [0, 1] that ascend, one a level, "
                "got others."
            )
        return table

    def plain(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def fit_table(
    scores: Sequence[ndarray], levels: tuple[float, ...] = LEVELS
) -> ConformalTable:
    """Finds t(u) from the scores of calibration maps.

    Args:
        scores: PIT values of the cells of each map, each of shape [N], N of its own;
            maps without any are left out.
        levels: u, ascending from 0 to 1.

    Raises:
        ConfigError: no map has a score.
    """
    maps = [own for own in scores if len(own)]
    expect(len(maps) > 0, "maps with an observed λ to calibrate on, got none.")
    weight = 1 / (len(maps) + 1)
    weights = np.concatenate([np.full(len(own), weight / len(own)) for own in maps])
    pooled = np.concatenate(maps)
    order = np.argsort(pooled, kind="stable")
    # Of the scores up to each, the share; t may rise to the first with which the share
    # is over u.
    share = weight + weights[order].cumsum()
    first = np.searchsorted(share, np.array(levels) - _ROUNDING)
    values = np.append(pooled[order], 1.0)[first]
    values = np.where(np.array(levels) < weight - _ROUNDING, 0.0, values)
    values[np.array(levels) >= 1] = 1.0
    return ConformalTable(levels=levels, values=tuple(values.tolist()), maps=len(maps))


def recalibrated(
    distribution: TraversabilityDistribution, table: ConformalTable
) -> QuantileDistribution:
    """Gives the distribution whose quantiles at the levels of a table are those of
    another at the table's values.

    Args:
        distribution: of shape [*B, H, W].
        table: from `fit_table`.
    """
    return quantiles_at(distribution, table.values, table.levels)


class ConformalModel(TraversabilityModel):
    """A model whose distributions are recalibrated; it tells no classes.

    Args:
        model: any model.
        table: from `fit_table`, by maps that the model has not seen.
    """

    def __init__(self, model: TraversabilityModel, table: ConformalTable) -> None:
        """Keeps them."""
        self.model, self.table = model, table

    def predict(self, observation: Observation) -> QuantileDistribution:
        """Predicts by the model and recalibrates; distributions of shape [B, H, W]."""
        return recalibrated(self.model.predict(observation), self.table)
