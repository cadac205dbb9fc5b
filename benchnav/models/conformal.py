"""Conformal recalibration: lower quantiles with guaranteed coverage on a new map of the
same kind.

The scores are the PIT values s = F(λ) of the cells of calibration maps, which no part of
the model has seen. If λ has an atom, s is drawn uniformly within the jump of F. Cells of
a map are spatially correlated, so the statistical unit is the map: each map has the same
weight, whatever its number of cells, and one additional map counts as if all its scores
were 0. With n maps, and G_j(t) the fraction of the scores of map j below t,

    t(u) = sup {t : (G_1(t) + … + G_n(t) + 1) / (n + 1) ≤ u},    Q_conf(u) = Q(t(u)).

**Guarantee.** Let the calibration maps and a new map be exchangeable, and the model be
trained without them. Then for a random cell of the new map, P(λ < Q_conf(u)) ≤ u at each
level u of the table; between two levels, the probability is at most the upper level.
Proof: let t* be the supremum of t with (G_1(t) + … + G_{n+1}(t)) / (n + 1) ≤ u, where
map n + 1 is the new map. G_{n+1} ≤ 1, so t(u) ≤ t*. The maps are exchangeable in t*, so
P(s < t*) for a cell of the new map is the expected mean of G_j(t*) over all n + 1 maps,
which is at most u. λ < Q(t) implies F(λ) < t, hence s < t.

The guarantee holds on average over new maps and over the choice of calibration maps. It
is one-sided, applies to quantiles and not to CVaR, and does not apply to other terrain,
such as the scenarios hg and hs. Its cost is that probability 1 / (n + 1) moves to the
lowest λ.
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

_ROUNDING = 1e-9  # tolerance of sums of weights


@dataclass(frozen=True, kw_only=True)
class ConformalTable:
    """Table of t(u): the model's quantile at level t(u) is a guaranteed u-quantile.

    Args:
        levels: u, ascending from 0 to 1.
        values: t(u) in [0, 1], never descending.
        maps: n, number of maps with scores.
    """

    levels: tuple[float, ...]
    values: tuple[float, ...]
    maps: int

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """Read a table from the result of `plain`.

        Raises:
            CheckpointError: If the data are not a valid table.
        """
        try:
            levels = tuple(map(float, data["levels"]))
            values = tuple(map(float, data["values"]))
            table = cls(levels=levels, values=values, maps=int(data["maps"]))
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                "Expected the table `conformal` of the checkpoint to have `levels`, "
                f"`values` and `maps`, got {type(error).__name__} {error}. Train the "
                "model again."
            ) from error
        ascends = all(low <= high for low, high in pairwise((0.0, *values, 1.0)))
        if len(levels) != len(values) or not ascends:
            raise CheckpointError(
                "Expected the table `conformal` of the checkpoint to have one value in "
                "[0, 1] per level, and values that never decrease, got other values. "
                "Train the model again."
            )
        return table

    def plain(self) -> dict[str, Any]:
        """Return the table as plain data, for JSON."""
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
    expect(len(maps) > 0, "calibration maps with observed λ, got 0 such maps.")
    map_weight = 1 / (len(maps) + 1)
    weights = np.concatenate(
        [np.full(len(map_scores), map_weight / len(map_scores)) for map_scores in maps]
    )
    pooled = np.concatenate(maps)
    order = np.argsort(pooled, kind="stable")
    # t(u) is the first score at which the cumulative weight exceeds u.
    cumulative = map_weight + weights[order].cumsum()
    u = np.array(levels)
    first_index = np.searchsorted(cumulative, u - _ROUNDING)
    values = np.append(pooled[order], 1.0)[first_index]
    values = np.where(u < map_weight - _ROUNDING, 0.0, values)
    values[u >= 1] = 1.0
    return ConformalTable(levels=levels, values=tuple(values.tolist()), maps=len(maps))


def recalibrated(
    distribution: TraversabilityDistribution, table: ConformalTable
) -> QuantileDistribution:
    """Return the distribution whose u-quantile is the t(u)-quantile of a prediction.

    Args:
        distribution: prediction of a model, shape [*B, H, W].
        table: result of `fit_table`.
    """
    return quantiles_at(distribution, table.values, table.levels)


class ConformalModel(TraversabilityModel):
    """A model whose distributions are recalibrated; it predicts no classes.

    Args:
        model: any model.
        table: result of `fit_table` on maps that the model has not seen.
    """

    def __init__(self, model: TraversabilityModel, table: ConformalTable) -> None:
        """Store model and table."""
        self.model = model
        self.table = table

    def predict(self, observation: Observation) -> QuantileDistribution:
        """Return recalibrated predictions of the model, of shape [B, H, W]."""
        return recalibrated(self.model.predict(observation), self.table)
