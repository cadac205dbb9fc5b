"""λ by normal score, cell by cell: a table that tells the distribution of a conditioned
cell quickly.

A row is of one cell and has the normal scores of `VALUES` under the cell's prediction,
which give P(λ ≤ value) where something is known of the score. Rows are made of the
cells that are asked for alone, and kept for when they are asked for again.
Letters in shapes: B episodes, H×W cells, *B any leading dimensions, K values of λ, R
rows, N cells.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from benchnav.core.batch import Batch, map_tensors
from benchnav.core.conditioned import LEAST_SKEW, unskewed
from benchnav.core.distribution import TraversabilityDistribution, check_floor, tail_of

VALUES: tuple[float, ...] = (
    *(round(0.005 * step, 3) for step in range(40)),
    *(round(0.2 + 0.02 * step, 2) for step in range(41)),
)
"""λ between which a belief's CDF is linear: denser where risk is."""
_MOST_SCORE = 9.0  # beyond which ranks are alike
_LEAST_STD = 1e-9
_AT_ONCE = 512  # cells, so that what is worked on stays in the cache


@dataclass(frozen=True)
class TabulatedDistribution(TraversabilityDistribution):
    """λ by its CDF at `VALUES`, linear in between; atoms are at 0 and at 1 alone.

    Args:
        below: P(λ ≤ value), at 1 P(λ < 1), shape [*B, K, H, W].
    """

    below: Tensor

    @property
    def shape(self) -> torch.Size:
        """[*B, H, W]."""
        return self.below.select(-3, 0).shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """P(λ ≤ value), shape [*B, H, W]; see the base."""
        return self.cdf_limits(value)[1]

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """P(λ < value) and P(λ ≤ value), each of shape [*B, H, W]; see the base."""
        at = torch.as_tensor(value, dtype=self.dtype, device=self.device)
        after = torch.searchsorted(self._values(), at.contiguous()).clamp(
            1, len(VALUES) - 1
        )
        places = [own.expand(self.shape).unsqueeze(-3) for own in (after - 1, after)]
        low, high = (self.below.gather(-3, own).squeeze(-3) for own in places)
        before, behind = self._values()[after - 1], self._values()[after]
        inside = torch.lerp(low, high, ((at - before) / (behind - before)).clamp(0, 1))
        return torch.where(at <= 0, 0.0, inside), torch.where(
            at < 0, 0.0, torch.where(at < 1, inside, 1.0)
        )

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Least λ that is not exceeded with this probability, shape [*B, H, W]; see the
        base.
        """
        share = torch.as_tensor(
            probability, dtype=self.dtype, device=self.device
        ).expand(self.shape)
        return value_at(
            self.below.movedim(-3, -1).contiguous(), share.unsqueeze(-1)
        ).squeeze(-1)

    def mean(self) -> Tensor:
        """E[λ], shape [*B, H, W]."""
        return self.cvar(0.0)

    def cvar(self, level: float) -> Tensor:
        """Mean of λ over its worst share 1 − level, 1/p ∫₀¹ max(p − F, 0), shape [*B,
        H, W]; see the base.
        """
        tail = tail_of(level)
        below, step = self.below.movedim(-3, -1), self._values().diff()
        left = (tail - below).clamp(min=0)
        low, high = left[..., :-1], left[..., 1:]
        if tail == 1:  # F passes it nowhere
            return ((low + high) / 2 @ step).clamp(max=1)
        # Where F passes p, of the interval the part before.
        part = low / torch.where(high > 0, 1.0, below.diff(dim=-1).clamp(min=1e-30))
        pieces = torch.where(high > 0, (low + high) / 2, low * part / 2)
        return ((pieces @ step) / tail).clamp(max=1)  # which rounding may pass

    def expected_time(self, floor: float) -> Tensor:
        """E[1 / max(λ, floor)] = 1 + ∫ F / λ² from the floor to 1, shape [*B, H, W];
        see the base.
        """
        check_floor(floor)
        low, high = np.array(VALUES[:-1]), np.array(VALUES[1:])
        start, end = np.maximum(low, floor), np.maximum(high, floor)
        times, logs = 1 / start - 1 / end, np.log(end / start)
        weights = np.zeros(len(VALUES))
        weights[:-1] += (high * times - logs) / (high - low)
        weights[1:] += (logs - low * times) / (high - low)
        return 1 + self.below.movedim(-3, -1) @ self.below.new_tensor(weights)

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """CVaR of the time 1 / max(λ, floor), shape [*B, H, W]; see the base."""
        tail = tail_of(level)
        check_floor(floor)
        below, values = self.below.movedim(-3, -1), self._values()
        low, high = values[:-1], values[1:].clamp(min=floor)
        slope = below.diff(dim=-1) / values.diff()
        # Where F passes p, the CDF of the tail is linear up to there, and 1 from there
        # on.
        whole = low + (tail - below[..., :-1]).clamp(min=0) / slope.clamp(min=1e-30)
        split = torch.minimum(whole.clamp(min=floor), high)
        start = low.clamp(min=floor)
        linear = (below[..., :-1] - slope * low) * (1 / start - 1 / split) + slope * (
            split / start
        ).log()
        return 1 + (linear / tail + (1 / split - 1 / high)).sum(-1)

    def _values(self) -> Tensor:
        return self.below.new_tensor(VALUES)


def value_at(rows: Tensor, wanted: Tensor) -> Tensor:
    """λ at which numbers that rise with λ reach others: 0 and 1 beyond their ends.

    Args:
        rows: of each cell at `VALUES`, shape [*B, K].
        wanted: shape [*B, N].

    Returns:
        Shape [*B, N].
    """
    after = torch.searchsorted(rows, wanted.contiguous())
    upper = after.clamp(1, len(VALUES) - 1)
    low, high = rows.gather(-1, upper - 1), rows.gather(-1, upper)
    part = ((wanted - low) / torch.where(high > low, high - low, 1.0)).clamp(0, 1)
    values = rows.new_tensor(VALUES)
    inside = torch.lerp(values[upper - 1], values[upper], part)
    return torch.where(after == len(VALUES), 1.0, torch.where(after == 0, 0.0, inside))


@dataclass(frozen=True)
class _Rows:
    """Scores of `VALUES`, float32, shape [R, K]; of several episodes together, so that
    `select` leaves them.
    """

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
        rows = torch.cat(
            (self.rows.scores[self.place[kept]], scores_of(prior.at(lacking)))
        )
        place = torch.full_like(self.place, -1)
        for which, first in ((kept, 0), (lacking, int(kept.sum()))):
            place[which] = torch.arange(
                first, first + int(which.sum()), device=place.device
            )
        return ScoreTable(place, _Rows(rows))

    def below(self, cells: Tensor, mean: Tensor, std: Tensor, skew: Tensor) -> Tensor:
        """P(λ ≤ value) at `VALUES`, at 1 P(λ < 1), of cells whose score has a
        posterior, shape [N, K].

        Args:
            cells: which of them, bool, shape [B, H, W]; each has a row.
            mean: of their scores, shape [N].
            std: of their scores, shape [N].
            skew: of their scores, shape [N].
        """
        scores = self.rows.scores[self.place[cells]]
        mean, std = mean.to(scores), std.to(scores).clamp(min=_LEAST_STD)
        away = (scores - mean[:, None]) / std[:, None]
        some = skew.abs() >= LEAST_SKEW
        if bool(some.any()):
            away = away.index_put(
                (some,), unskewed(away[some], skew[some, None]).to(away)
            )
        return (1 + torch.erf(away * math.sqrt(0.5))) / 2


def scores_of(prior: TraversabilityDistribution) -> Tensor:
    """Normal scores of `VALUES` in each cell of a map of one row, [1, R], float32,
    shape [R, K].

    Of an atom at 0 and at 1 it is the end that is nearer to the other values.
    """
    count = prior.shape[-1]
    parts = [
        _scores_of(prior, start, start + _AT_ONCE)
        for start in range(0, max(count, 1), _AT_ONCE)
    ]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _scores_of(prior: TraversabilityDistribution, start: int, end: int) -> Tensor:
    """Those of some cells, all values at once."""
    cells = map_tensors(
        prior, lambda of: of[..., start:end].repeat_interleave(len(VALUES), dim=-1)
    )
    value = torch.tensor(VALUES, dtype=torch.float64, device=prior.device).repeat(
        cells.shape[-1] // len(VALUES)
    )
    low, high = cells.to_normal(value[None])
    ends = torch.where(value < 1, high, low)[0]
    return ends.float().clamp(-_MOST_SCORE, _MOST_SCORE).view(-1, len(VALUES))
