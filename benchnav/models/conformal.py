"""Conformal recalibration: lower quantiles with guaranteed coverage on a new map of the
same kind.

Calibration maps that no part of a model has seen yield scores: the PIT values s = F(λ)
of their cells, drawn within the jump where λ has an atom. Cells of a map are spatially
correlated, so maps are the unit: each has the same weight, whatever its number of
cells, and one additional map counts as if all its scores were 0. With n maps, and
G_j(t) the fraction of the scores of map j below t,

    t(u) = sup {t : (G_1(t) + … + G_n(t) + 1) / (n + 1) ≤ u},    Q_conf(u) = Q(t(u)).

**Guarantee.** Let these maps and a new one be exchangeable, and the model be trained
without them. Then for a random cell of the new map, at each level u of the table, P(λ <
Q_conf(u)) ≤ u; between levels, at most the next level. Proof: let t* be the supremum of
t with (G_1(t) + … + G_{n+1}(t)) / (n + 1) ≤ u, the new map included. G_{n+1} ≤ 1, so
t(u) ≤ t*. The maps are exchangeable in t*, so P(s < t*) for a cell of the new map is
the expected mean of G_j(t*) over all maps, which is at most u. And λ < Q(t) means F(λ)
< t, hence s < t.

The guarantee holds on average over new maps and over the choice of calibration maps. It
is one-sided, applies to quantiles and not to CVaR, and does not apply to other terrain
such as hg or hs. Its cost is that probability 1 / (n + 1) moves to the lowest λ.
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
    """Levels at which a model's own quantiles are guaranteed quantiles.

    Args:
        levels: u, ascending from 0 to 1.
        values: t(u) in [0, 1], not descending.
        maps: n, number of maps with scores.
    """

    levels: tuple[float, ...]
    values: tuple[float, ...]
    maps: int

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """Read the result of `plain`.

        Raises:
            CheckpointError: If it is not a valid table.
        """
        try:
            levels = tuple(map(float, data["levels"]))
            values = tuple(map(float, data["values"]))
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
        """Return plain data."""
        return asdict(self)


def fit_table(
    scores: Sequence[ndarray], levels: tuple[float, ...] = LEVELS
) -> ConformalTable:
    """Compute t(u) from the scores of calibration maps.

    Args:
        scores: PIT values of the cells of each map, each of shape [N] with its own N;
            maps without cells are left out.
        levels: u, ascending from 0 to 1.

    Raises:
        ConfigError: If no map has a score.
    """
    maps = [map_scores for map_scores in scores if len(map_scores)]
    expect(len(maps) > 0, "maps with an observed λ to calibrate on, got none.")
    map_weight = 1 / (len(maps) + 1)
    weights = np.concatenate(
        [np.full(len(map_scores), map_weight / len(map_scores)) for map_scores in maps]
    )
    pooled = np.concatenate(maps)
    order = np.argsort(pooled, kind="stable")
    # Weight of the scores up to each; t may rise to the first whose weight exceeds u.
    cumulative = map_weight + weights[order].cumsum()
    u = np.array(levels)
    first = np.searchsorted(cumulative, u - _ROUNDING)
    values = np.append(pooled[order], 1.0)[first]
    values = np.where(u < map_weight - _ROUNDING, 0.0, values)
    values[u >= 1] = 1.0
    return ConformalTable(levels=levels, values=tuple(values.tolist()), maps=len(maps))


def recalibrated(
    distribution: TraversabilityDistribution, table: ConformalTable
) -> QuantileDistribution:
    """Return the distribution whose quantiles at a table's levels are those at its values.

    Args:
        distribution: of shape [*B, H, W].
        table: from `fit_table`.
    """
    return quantiles_at(distribution, table.values, table.levels)


class ConformalModel(TraversabilityModel):
    """A model with recalibrated distributions and without classes.

    Args:
        model: any model.
        table: from `fit_table`, on maps that the model has not seen.
    """

    def __init__(self, model: TraversabilityModel, table: ConformalTable) -> None:
        """Store model and table."""
        self.model = model
        self.table = table

    def predict(self, observation: Observation) -> QuantileDistribution:
        """Return recalibrated predictions of the model, of shape [B, H, W]."""
        return recalibrated(self.model.predict(observation), self.table)
