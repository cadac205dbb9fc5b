"""Tables of normal scores by λ: fast distributions of cells after conditioning.

A row of a table belongs to one cell and contains the normal scores of `VALUES` under
the cell's prediction. With a posterior of the score, P(λ ≤ value) follows from these.
Rows are computed only for requested cells, and are cached.
Letters in shapes: B episodes, H×W cells, *B any leading dimensions, K values of λ, R
rows, N cells.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from benchnav.core.batch import Batch, map_tensors
from benchnav.core.conditioned import MIN_SKEW, unskewed
from benchnav.core.distribution import TraversabilityDistribution, check_floor, tail_of

VALUES: tuple[float, ...] = (
    *(round(0.005 * step, 3) for step in range(40)),
    *(round(0.2 + 0.02 * step, 2) for step in range(41)),
)
"""Values of λ between which a belief's CDF is linear, denser in the lower tail."""
_MAX_SCORE = 9.0  # beyond it, Φ equals 1 in float64
_MIN_STD = 1e-9
_CHUNK_SIZE = 512  # in cells; intermediate results then fit the CPU cache


@dataclass(frozen=True)
class TabulatedDistribution(TraversabilityDistribution):
    """Distribution of λ whose CDF is given at `VALUES` and linear between them.

    It may have atoms at 0 and 1 only.

    Args:
        below: P(λ ≤ value) at each of `VALUES`, but P(λ < 1) at 1, shape [*B, K, H, W].
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
        requested = torch.as_tensor(value, dtype=self.dtype, device=self.device)
        values = self._values()
        upper = torch.searchsorted(values, requested.contiguous()).clamp(
            1, len(VALUES) - 1
        )
        lower = upper - 1
        low = values[lower]
        high = values[upper]
        fraction = ((requested - low) / (high - low)).clamp(0, 1)
        inside = torch.lerp(self._below_at(lower), self._below_at(upper), fraction)
        strictly_below = torch.where(requested <= 0, 0.0, inside)
        at_most = torch.where(requested < 1, inside, 1.0)
        at_most = torch.where(requested < 0, 0.0, at_most)
        return strictly_below, at_most

    def _below_at(self, index: Tensor) -> Tensor:
        """Return `below` in each cell at that cell's index of `VALUES`, [*B, H, W]."""
        cell_index = index.expand(self.shape).unsqueeze(-3)
        return self.below.gather(-3, cell_index).squeeze(-3)

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Return quantiles of λ, shape [*B, H, W]; see the base class."""
        level = torch.as_tensor(probability, dtype=self.dtype, device=self.device)
        levels = level.expand(self.shape).unsqueeze(-1)
        rows = self.below.movedim(-3, -1).contiguous()
        return value_at(rows, levels).squeeze(-1)

    def mean(self) -> Tensor:
        """Return E[λ], shape [*B, H, W]."""
        return self.cvar(0.0)

    def cvar(self, level: float) -> Tensor:
        """Return the mean of λ over its worst 1 − level fraction, shape [*B, H, W].

        With p = 1 − level and the CDF F, it is 1/p ∫₀¹ max(p − F(λ), 0) dλ.
        """
        tail = tail_of(level)
        below = self.below.movedim(-3, -1)
        step = self._values().diff()
        remaining = (tail - below).clamp(min=0)
        low = remaining[..., :-1]
        high = remaining[..., 1:]
        mean_remaining = (low + high) / 2
        if tail == 1:  # F never exceeds p
            return (mean_remaining @ step).clamp(max=1)
        # In the interval in which F crosses p, only the part below p contributes.
        rise = below.diff(dim=-1).clamp(min=1e-30)
        is_before = high > 0
        fraction = low / torch.where(is_before, 1.0, rise)
        pieces = torch.where(is_before, mean_remaining, low * fraction / 2)
        mean = (pieces @ step) / tail
        return mean.clamp(max=1)  # may exceed 1 by rounding

    def expected_time(self, floor: float) -> Tensor:
        """Return E[1 / max(λ, floor)], shape [*B, H, W].

        With the CDF F, it is 1 + ∫ F(λ) / λ² dλ from the floor to 1.
        """
        check_floor(floor)
        low = np.array(VALUES[:-1])
        high = np.array(VALUES[1:])
        start = np.maximum(low, floor)
        end = np.maximum(high, floor)
        times = 1 / start - 1 / end
        logs = np.log(end / start)
        width = high - low
        weights = np.zeros(len(VALUES))
        weights[:-1] += (high * times - logs) / width
        weights[1:] += (logs - low * times) / width
        below = self.below.movedim(-3, -1)
        return 1 + below @ self.below.new_tensor(weights)

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """Return the CVaR of the time 1 / max(λ, floor), shape [*B, H, W]."""
        tail = tail_of(level)
        check_floor(floor)
        below = self.below.movedim(-3, -1)
        values = self._values()
        low = values[:-1]
        high = values[1:].clamp(min=floor)
        slope = below.diff(dim=-1) / values.diff()
        below_low = below[..., :-1]
        # The CDF of the tail is F/p up to the λ at which F = p, and 1 above it.
        remaining = (tail - below_low).clamp(min=0)
        crossing = low + remaining / slope.clamp(min=1e-30)
        split = torch.minimum(crossing.clamp(min=floor), high)
        start = low.clamp(min=floor)
        offset = below_low - slope * low
        log_growth = (split / start).log()
        linear = offset * (1 / start - 1 / split) + slope * log_growth
        excess = linear / tail + (1 / split - 1 / high)
        return 1 + excess.sum(-1)

    def _values(self) -> Tensor:
        return self.below.new_tensor(VALUES)


def value_at(rows: Tensor, levels: Tensor) -> Tensor:
    """Return the λ at which increasing functions of λ reach given levels.

    The result is 0 for levels below the first value of a row and 1 for levels above the
    last.

    Args:
        rows: each cell's function at `VALUES`, shape [*B, K].
        levels: N levels for each cell, shape [*B, N].

    Returns:
        λ, shape [*B, N].
    """
    index = torch.searchsorted(rows, levels.contiguous())
    upper = index.clamp(1, len(VALUES) - 1)
    lower = upper - 1
    low = rows.gather(-1, lower)
    high = rows.gather(-1, upper)
    rise = torch.where(high > low, high - low, 1.0)
    fraction = ((levels - low) / rise).clamp(0, 1)
    values = rows.new_tensor(VALUES)
    inside = torch.lerp(values[lower], values[upper], fraction)
    inside = torch.where(index == 0, 0.0, inside)
    return torch.where(index == len(VALUES), 1.0, inside)


@dataclass(frozen=True)
class _Rows:
    """Rows of a table.

    The rows of all episodes are stored together, so that `Batch.select` does not copy
    them.

    Args:
        scores: scores of `VALUES`, float32, shape [R, K].
    """

    scores: Tensor


@dataclass(frozen=True)
class ScoreTable(Batch):
    """Table with a row of scores for each cell that was requested so far.

    Args:
        row_index: index of each cell's row; −1 without a row, int64, shape [B, H, W].
        rows: rows of all episodes.
    """

    row_index: Tensor
    rows: _Rows

    @classmethod
    def empty(cls, prior: TraversabilityDistribution) -> "ScoreTable":
        """Return a table without rows."""
        row_index = torch.full(prior.shape, -1, dtype=torch.int64, device=prior.device)
        no_cells = prior.at(row_index >= 0)
        return cls(row_index, _Rows(scores_of(no_cells)))

    def put(self, members: Tensor, others: "ScoreTable") -> "ScoreTable":
        """Return the table with some episodes replaced; see `Batch.put`."""
        offset = len(self.rows.scores)
        has_row = others.row_index >= 0
        new_index = torch.where(has_row, others.row_index + offset, -1)
        row_index = self.row_index.index_copy(0, members, new_index)
        rows = torch.cat((self.rows.scores, others.rows.scores))
        return ScoreTable(row_index, _Rows(rows))

    def without_rows(self, cells: Tensor) -> "ScoreTable":
        """Return the table without the rows of the cells of a mask, bool, [B, H, W]."""
        return replace(self, row_index=self.row_index.masked_fill(cells, -1))

    def with_rows(
        self, prior: TraversabilityDistribution, cells: Tensor
    ) -> "ScoreTable":
        """Return the table with a row for each requested cell.

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
        """Return P(λ ≤ value) at each of `VALUES`, but P(λ < 1) at 1, shape [N, K].

        Args:
            cells: mask of N cells that have rows, bool, shape [B, H, W].
            mean: posterior mean of the cells' scores, shape [N].
            std: posterior standard deviation of the scores, shape [N].
            skew: posterior skewness of the scores, shape [N].
        """
        scores = self.rows.scores[self.row_index[cells]]
        mean = mean.to(scores)
        std = std.to(scores).clamp(min=_MIN_STD)
        normal = (scores - mean[:, None]) / std[:, None]
        is_skewed = skew.abs() >= MIN_SKEW
        if bool(is_skewed.any()):
            cell_skew = skew[is_skewed, None]
            unskewed_scores = unskewed(normal[is_skewed], cell_skew).to(normal)
            normal = normal.index_put((is_skewed,), unskewed_scores)
        return (1 + torch.erf(normal * math.sqrt(0.5))) / 2


def scores_of(prior: TraversabilityDistribution) -> Tensor:
    """Return normal scores of `VALUES` in each cell of a map of one row.

    The score of λ at an atom is an interval: its lower end is returned for λ = 1, and
    its upper end for all other λ.

    Args:
        prior: the prediction, shape [1, R].

    Returns:
        Scores, float32, shape [R, K].
    """
    n_cells = max(prior.shape[-1], 1)
    parts = []
    for start in range(0, n_cells, _CHUNK_SIZE):
        parts.append(_scores_of(prior, start, start + _CHUNK_SIZE))
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _scores_of(prior: TraversabilityDistribution, start: int, end: int) -> Tensor:
    """Return the scores of `VALUES` in the cells from `start` to `end` (exclusive)."""
    n_values = len(VALUES)

    def repeat(parameter: Tensor) -> Tensor:
        return parameter[..., start:end].repeat_interleave(n_values, dim=-1)

    cells = map_tensors(prior, repeat)
    n_cells = cells.shape[-1] // n_values
    values = torch.tensor(VALUES, dtype=torch.float64, device=prior.device)
    repeated = values.repeat(n_cells)
    low, high = cells.to_normal(repeated[None])
    ends = torch.where(repeated < 1, high, low)[0]
    clamped = ends.float().clamp(-_MAX_SCORE, _MAX_SCORE)
    return clamped.view(-1, n_values)
