"""Tables of λ by normal score: fast distributions of cells after conditioning.

A row belongs to one cell and contains the normal scores of `VALUES` under the cell's
prediction. They give P(λ ≤ value) for a posterior of the score. Rows are computed only
for requested cells, and are cached.
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
"""Values of λ between which a belief's CDF is linear: denser where risk is."""
_MAX_SCORE = 9.0  # beyond which ranks cannot be distinguished
_MIN_STD = 1e-9
_CHUNK_SIZE = 512  # cells, so that intermediate results fit the CPU cache


@dataclass(frozen=True)
class TabulatedDistribution(TraversabilityDistribution):
    """Distribution of λ by its CDF at `VALUES`, linear in between.

    Atoms are only at 0 and 1.

    Args:
        below: P(λ ≤ value), and at 1 P(λ < 1), shape [*B, K, H, W].
    """

    below: Tensor

    @property
    def shape(self) -> torch.Size:
        """Shape of the maps, [*B, H, W]."""
        return self.below.select(-3, 0).shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """Return P(λ ≤ value), shape [*B, H, W]; see the base class."""
        return self.cdf_limits(value)[1]

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return P(λ < value) and P(λ ≤ value), each of shape [*B, H, W]."""
        at = torch.as_tensor(value, dtype=self.dtype, device=self.device)
        values = self._values()
        upper = torch.searchsorted(values, at.contiguous()).clamp(1, len(VALUES) - 1)
        lower = upper - 1
        lower_cdf, upper_cdf = (
            self.below.gather(-3, index.expand(self.shape).unsqueeze(-3)).squeeze(-3)
            for index in (lower, upper)
        )
        fraction = (at - values[lower]) / (values[upper] - values[lower])
        inside = torch.lerp(lower_cdf, upper_cdf, fraction.clamp(0, 1))
        strictly_below = torch.where(at <= 0, 0.0, inside)
        at_most = torch.where(at < 0, 0.0, torch.where(at < 1, inside, 1.0))
        return strictly_below, at_most

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Return quantiles of λ, shape [*B, H, W]; see the base class."""
        level = torch.as_tensor(probability, dtype=self.dtype, device=self.device)
        rows = self.below.movedim(-3, -1).contiguous()
        levels = level.expand(self.shape).unsqueeze(-1)
        return value_at(rows, levels).squeeze(-1)

    def mean(self) -> Tensor:
        """Return E[λ], shape [*B, H, W]."""
        return self.cvar(0.0)

    def cvar(self, level: float) -> Tensor:
        """Return the mean of λ over its worst 1 − level fraction, shape [*B, H, W].

        With p = 1 − level it is 1/p ∫₀¹ max(p − F, 0).
        """
        tail = tail_of(level)
        below = self.below.movedim(-3, -1)
        step = self._values().diff()
        remaining = (tail - below).clamp(min=0)
        low = remaining[..., :-1]
        high = remaining[..., 1:]
        if tail == 1:  # F does not exceed it
            return ((low + high) / 2 @ step).clamp(max=1)
        # In the interval in which F exceeds p, only the part before counts.
        rise = below.diff(dim=-1).clamp(min=1e-30)
        part = low / torch.where(high > 0, 1.0, rise)
        pieces = torch.where(high > 0, (low + high) / 2, low * part / 2)
        return ((pieces @ step) / tail).clamp(max=1)  # may exceed 1 by rounding

    def expected_time(self, floor: float) -> Tensor:
        """Return E[1 / max(λ, floor)], shape [*B, H, W].

        It is 1 + ∫ F / λ² from the floor to 1.
        """
        check_floor(floor)
        low = np.array(VALUES[:-1])
        high = np.array(VALUES[1:])
        start = np.maximum(low, floor)
        end = np.maximum(high, floor)
        times = 1 / start - 1 / end
        logs = np.log(end / start)
        weights = np.zeros(len(VALUES))
        weights[:-1] += (high * times - logs) / (high - low)
        weights[1:] += (logs - low * times) / (high - low)
        return 1 + self.below.movedim(-3, -1) @ self.below.new_tensor(weights)

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """Return the CVaR of the time 1 / max(λ, floor), shape [*B, H, W]."""
        tail = tail_of(level)
        check_floor(floor)
        below = self.below.movedim(-3, -1)
        values = self._values()
        low = values[:-1]
        high = values[1:].clamp(min=floor)
        slope = below.diff(dim=-1) / values.diff()
        # In the interval in which F exceeds p, the CDF of the tail is linear up to that
        # λ, and 1 above it.
        remaining = (tail - below[..., :-1]).clamp(min=0)
        crossing = low + remaining / slope.clamp(min=1e-30)
        split = torch.minimum(crossing.clamp(min=floor), high)
        start = low.clamp(min=floor)
        offset = below[..., :-1] - slope * low
        linear = offset * (1 / start - 1 / split) + slope * (split / start).log()
        return 1 + (linear / tail + (1 / split - 1 / high)).sum(-1)

    def _values(self) -> Tensor:
        return self.below.new_tensor(VALUES)


def value_at(rows: Tensor, levels: Tensor) -> Tensor:
    """Return λ at which numbers that increase with λ reach levels.

    It is 0 below the first number of a row and 1 above the last.

    Args:
        rows: numbers of each cell at `VALUES`, shape [*B, K].
        levels: levels, shape [*B, N].

    Returns:
        λ, shape [*B, N].
    """
    after = torch.searchsorted(rows, levels.contiguous())
    upper = after.clamp(1, len(VALUES) - 1)
    low = rows.gather(-1, upper - 1)
    high = rows.gather(-1, upper)
    fraction = (levels - low) / torch.where(high > low, high - low, 1.0)
    values = rows.new_tensor(VALUES)
    inside = torch.lerp(values[upper - 1], values[upper], fraction.clamp(0, 1))
    return torch.where(after == len(VALUES), 1.0, torch.where(after == 0, 0.0, inside))


@dataclass(frozen=True)
class _Rows:
    """Scores of `VALUES`, float32, shape [R, K].

    Rows of several episodes together, so that `select` leaves them as they are.
    """

    scores: Tensor


@dataclass(frozen=True)
class ScoreTable(Batch):
    """Scores of `VALUES` of the requested cells.

    Args:
        row_index: row of each cell, −1 if it has none, int64, shape [B, H, W].
        rows: rows of all episodes.
    """

    row_index: Tensor
    rows: _Rows

    @classmethod
    def empty(cls, prior: TraversabilityDistribution) -> "ScoreTable":
        """Return a table without rows."""
        row_index = torch.full(prior.shape, -1, dtype=torch.int64, device=prior.device)
        return cls(row_index, _Rows(scores_of(prior.at(row_index >= 0))))

    def put(self, members: Tensor, others: "ScoreTable") -> "ScoreTable":
        """Replace episodes; see `Batch`."""
        offset = len(self.rows.scores)
        row_index = torch.where(others.row_index >= 0, others.row_index + offset, -1)
        rows = torch.cat((self.rows.scores, others.rows.scores))
        return ScoreTable(self.row_index.index_copy(0, members, row_index), _Rows(rows))

    def without(self, cells: Tensor) -> "ScoreTable":
        """Return the table without the rows of some cells, bool, [B, H, W]."""
        return replace(self, row_index=self.row_index.masked_fill(cells, -1))

    def having(self, prior: TraversabilityDistribution, cells: Tensor) -> "ScoreTable":
        """Return a table that has a row of each of some cells.

        Args:
            prior: the prediction, shape [B, H, W].
            cells: mask of the cells, bool, shape [B, H, W].
        """
        has_row = self.row_index >= 0
        missing = cells & ~has_row
        if not bool(missing.any()):
            return self
        old_rows = self.rows.scores[self.row_index[has_row]]
        rows = torch.cat((old_rows, scores_of(prior.at(missing))))
        row_index = torch.full_like(self.row_index, -1)
        start = 0
        for mask in (has_row, missing):
            end = start + int(mask.sum())
            row_index[mask] = torch.arange(start, end, device=row_index.device)
            start = end
        return ScoreTable(row_index, _Rows(rows))

    def below(self, cells: Tensor, mean: Tensor, std: Tensor, skew: Tensor) -> Tensor:
        """Return P(λ ≤ value) at `VALUES`, and at 1 P(λ < 1), of cells, [N, K].

        Args:
            cells: mask of the cells, bool, shape [B, H, W]; each has a row.
            mean: mean of the posterior of their scores, shape [N].
            std: its standard deviation, shape [N].
            skew: its skewness, shape [N].
        """
        scores = self.rows.scores[self.row_index[cells]]
        mean, std = mean.to(scores), std.to(scores).clamp(min=_MIN_STD)
        away = (scores - mean[:, None]) / std[:, None]
        is_skewed = skew.abs() >= LEAST_SKEW
        if bool(is_skewed.any()):
            normal = unskewed(away[is_skewed], skew[is_skewed, None]).to(away)
            away = away.index_put((is_skewed,), normal)
        return (1 + torch.erf(away * math.sqrt(0.5))) / 2


def scores_of(prior: TraversabilityDistribution) -> Tensor:
    """Return normal scores of `VALUES` in each cell of a map of one row, [1, R].

    Float32, shape [R, K]. At an atom at 0 or 1 the score is the end of its interval
    that is nearer to the other values.
    """
    count = prior.shape[-1]
    parts = [
        _scores_of(prior, start, start + _CHUNK_SIZE)
        for start in range(0, max(count, 1), _CHUNK_SIZE)
    ]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _scores_of(prior: TraversabilityDistribution, start: int, end: int) -> Tensor:
    """Return the scores of a chunk of cells, all values at once."""
    n_values = len(VALUES)
    cells = map_tensors(
        prior, lambda of: of[..., start:end].repeat_interleave(n_values, dim=-1)
    )
    values = torch.tensor(VALUES, dtype=torch.float64, device=prior.device)
    value = values.repeat(cells.shape[-1] // n_values)
    low, high = cells.to_normal(value[None])
    ends = torch.where(value < 1, high, low)[0]
    return ends.float().clamp(-_MAX_SCORE, _MAX_SCORE).view(-1, n_values)
