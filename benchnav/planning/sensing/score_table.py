"""λ by normal score, cell by cell: a table that tells the quantiles of a conditioned cell quickly.

A row is of one cell and has the normal scores of `VALUES` under the cell's prediction. Between them λ is taken to be
linear in the score. Rows are made of the cells that are asked for alone, and kept for when they are asked for again.
Letters in shapes: B episodes, H×W cells, K values of λ, R rows, N cells.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.conditioned import skewed, unskewed
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.quantiles import QuantileDistribution

VALUES: tuple[float, ...] = (
    *(round(0.005 * step, 3) for step in range(40)),
    *(round(0.2 + 0.02 * step, 2) for step in range(41)),
)
"""λ between which a belief's quantiles are linear in the normal score: denser where risk is."""
_LEVELS: tuple[float, ...] = (
    *(round(0.0025 * step, 4) for step in range(80)),
    *(round(0.2 + 0.02 * step, 2) for step in range(40)),
    *(0.99, 0.995, 0.9975, 1.0),
)
_MOST_SCORE = 9.0  # beyond which ranks are alike
_LAST_RANK = 3.4  # at levels 0 and 1, so that the mean of the ranks beyond the next level is right
_LEAST_STD = 1e-9


@dataclass(frozen=True)
class _Rows:
    """Scores of `VALUES`, float32, shape [R, K]; of several episodes together, so that `select` leaves them."""

    scores: Tensor


@dataclass(frozen=True)
class ScoreTable(Batch):
    """Scores of `VALUES` of the cells that were asked for.

    Args:
        place: which row is of a cell, −1 where none is, int64, shape [B, H, W].
        rows: of all episodes.
    """

    place: Tensor
    rows: _Rows

    @classmethod
    def empty(cls, prior: TraversabilityDistribution) -> "ScoreTable":
        """A table that has no row."""
        none = torch.full(prior.shape, -1, dtype=torch.int64, device=prior.device)
        return cls(none, _Rows(scores_of(prior.at(none >= 0))))

    def put(self, members: Tensor, others: "ScoreTable") -> "ScoreTable":
        """Puts episodes in the places of others; see `Batch`."""
        place = torch.where(others.place >= 0, others.place + len(self.rows.scores), -1)
        rows = torch.cat((self.rows.scores, others.rows.scores))
        return ScoreTable(self.place.index_copy(0, members, place), _Rows(rows))

    def without(self, cells: Tensor) -> "ScoreTable":
        """Forgets some cells, bool [B, H, W], whose prediction has changed."""
        return replace(self, place=self.place.masked_fill(cells, -1))

    def having(self, prior: TraversabilityDistribution, cells: Tensor) -> "ScoreTable":
        """A table that has a row of each of some cells.

        Args:
            prior: the prediction, shape [B, H, W].
            cells: which of them, bool, shape [B, H, W].
        """
        kept = self.place >= 0
        lacking = cells & ~kept
        if not bool(lacking.any()):
            return self
        rows = torch.cat((self.rows.scores[self.place[kept]], scores_of(prior.at(lacking))))
        place = torch.full_like(self.place, -1)
        for which, first in ((kept, 0), (lacking, int(kept.sum()))):
            place[which] = torch.arange(first, first + int(which.sum()), device=place.device)
        return ScoreTable(place, _Rows(rows))

    def quantiles(self, cells: Tensor, mean: Tensor, std: Tensor, skew: Tensor) -> QuantileDistribution:
        """λ of cells whose score has a posterior, as a map of one row, [1, N].

        Args:
            cells: which of them, bool, shape [B, H, W]; each has a row.
            mean: of their scores, shape [N].
            std: of their scores, shape [N].
            skew: of their scores, shape [N].
        """
        scores = self.rows.scores[self.place[cells]]
        device, dtype = scores.device, scores.dtype
        ranks = torch.special.ndtri(torch.tensor(_LEVELS, dtype=torch.float64, device=device))
        ranks = ranks.clamp(-_LAST_RANK, _LAST_RANK).expand(len(mean), -1)
        some = skew != 0
        if bool(some.any()):
            ranks = ranks.contiguous().index_put((some,), skewed(ranks[some], skew[some, None]))
        wanted = torch.addcmul(mean[:, None], std[:, None], ranks).to(dtype)
        values = torch.tensor(VALUES, dtype=dtype, device=device)
        after = torch.searchsorted(scores, wanted).clamp(1, len(VALUES) - 1)
        low, high = scores.gather(1, after - 1), scores.gather(1, after)
        part = ((wanted - low) / torch.where(high > low, high - low, 1.0)).clamp(0, 1)
        found = torch.lerp(values[after - 1], values[after], part)
        return QuantileDistribution(found.T[:, None], _LEVELS)

    def cdf(self, cells: Tensor, mean: Tensor, std: Tensor, skew: Tensor) -> Tensor:
        """P(λ ≤ value) at `VALUES`, of 1 P(λ < 1), of cells whose score has a posterior, float64, shape [N, K].

        Args:
            cells: as of `quantiles`, and so are the others.
            mean: shape [N].
            std: shape [N].
            skew: shape [N].
        """
        away = self.rows.scores[self.place[cells]] - mean[:, None]
        away = away / std[:, None].clamp(min=_LEAST_STD)
        some = skew != 0
        if bool(some.any()):
            away = away.index_put((some,), unskewed(away[some], skew[some, None]))
        return torch.special.ndtr(away)


def quantiles_of(cdf: Tensor) -> QuantileDistribution:
    """λ of cells as a map of one row, [1, N], by P(λ ≤ value) at `VALUES`, of 1 P(λ < 1), float64, shape [N, K]."""
    ranks = torch.special.ndtri(torch.tensor(_LEVELS, dtype=torch.float64, device=cdf.device))
    levels = torch.special.ndtr(ranks.clamp(-_LAST_RANK, _LAST_RANK)).expand(len(cdf), -1).contiguous()
    after = torch.searchsorted(cdf, levels).clamp(1, len(VALUES) - 1)
    low, high = cdf.gather(1, after - 1), cdf.gather(1, after)
    part = ((levels - low) / torch.where(high > low, high - low, 1.0)).clamp(0, 1)
    values = cdf.new_tensor(VALUES)
    return QuantileDistribution(torch.lerp(values[after - 1], values[after], part).T[:, None], _LEVELS)


def scores_of(prior: TraversabilityDistribution) -> Tensor:
    """Normal scores of `VALUES` in each cell of a map of one row, [1, R], float32, shape [R, K].

    Of an atom at 0 and at 1 it is the end that is nearer to the other values.
    """
    ends = [prior.to_normal(value)[value < 1] for value in VALUES]
    return torch.cat([end.float().clamp(-_MOST_SCORE, _MOST_SCORE) for end in ends]).T.contiguous()
