"""Distributions given by their quantiles, as in quantile regression.

The quantile function has the values x_i at levels u_i and is linear in between. If it
is constant over an interval of levels, λ has an atom. Mean, VaR and CVaR are weighted
sums of the x_i; expected time and CRPS are sums over intervals. All are exact.
Letters in shapes: Q levels; H×W cells; *B any leading dimensions.
"""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution, check_floor, tail_of
from benchnav.core.errors import ConfigError, expect

_MIN_LEVELS = 64  # minimum number of levels
_TAIL = 0.1  # upper end of the tail, as a level
_TAIL_STEP = 0.01  # maximum difference between levels in the tail

LEVELS: tuple[float, ...] = (
    *(0.0, 0.001, 0.002, 0.003, 0.005, 0.0075),
    *(round(0.01 + 0.005 * step, 3) for step in range(18)),
    *(round(0.1 + 0.02 * step, 2) for step in range(45)),
    *(0.99, 0.995, 1.0),
)
"""Default levels of models: 72 levels, a third of them in the lower tail up to 0.1."""


@dataclass(frozen=True)
class QuantileDistribution(TraversabilityDistribution):
    """Quantiles of λ in each cell, with linear interpolation.

    Args:
        values: quantiles of λ at the levels, never descending, in [0, 1], shape
            [*B, Q, H, W]. Equal values at several levels form an atom.
        levels: at least 64 levels, ascending from 0 (the minimum of λ) to 1 (its
            maximum), and at most 0.01 apart up to level 0.1.

    Raises:
        ConfigError: If the levels or the shape are invalid.
    """

    values: Tensor
    levels: tuple[float, ...] = LEVELS

    def __post_init__(self) -> None:
        """Validate levels and shape; `check_model` validates that values ascend."""
        # Python floats, since PyTorch would trace an array during export of a graph.
        levels = self.levels
        steps = [upper - lower for lower, upper in pairwise(levels)]
        spans = bool(levels) and levels[0] == 0 and levels[-1] == 1
        is_ascending = bool(steps) and min(steps) > 0
        expect(
            len(levels) >= _MIN_LEVELS,
            f"at least {_MIN_LEVELS} `levels`, got {len(levels)}. Use "
            "`benchnav.core.quantiles.LEVELS`.",
        )
        expect(
            spans and is_ascending,
            f"`levels` that ascend from 0 to 1, got {levels}. Use "
            "`benchnav.core.quantiles.LEVELS`.",
        )
        # Steps that start in the tail. Rounding must not add the step from level 0.1.
        n_tail_steps = bisect_left(levels, _TAIL - 1e-9)
        max_step = max(steps[:n_tail_steps])
        expect(
            max_step <= _TAIL_STEP + 1e-9,
            f"`levels` at most {_TAIL_STEP} apart in the tail up to {_TAIL}, got a "
            f"step of {max_step:.3g}. Risk depends on this tail. Add levels to it.",
        )
        shape = self.values.shape
        if len(shape) < 3 or shape[-3] != len(levels):
            raise ConfigError(
                f"Expected `values` of shape [*B, {len(levels)}, H, W], with one map "
                f"per level, got {list(shape)}."
            )

    @property
    def shape(self) -> torch.Size:
        """Shape of the maps, [*B, H, W]."""
        return self.values.select(-3, 0).shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """Return P(λ ≤ value), shape [*B, H, W]."""
        return self.cdf_limits(value)[1]

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return P(λ < value) and P(λ ≤ value), each of shape [*B, H, W]."""
        value = torch.as_tensor(value, dtype=torch.float64, device=self.device)
        at = value.expand(self.shape).unsqueeze(-1)
        knots = self._knots()
        levels = self._levels()

        def cdf_at(right: bool) -> Tensor:
            index = torch.searchsorted(knots, at.contiguous(), right=right)
            upper = index.clamp(max=len(levels) - 1)
            lower = (index - 1).clamp(min=0)
            low = knots.gather(-1, lower)
            high = knots.gather(-1, upper)
            fraction = _fraction(at, low, high)
            probability = torch.lerp(levels[lower], levels[upper], fraction)
            probability = torch.where(index == len(levels), 1.0, probability)
            probability = torch.where(index == 0, 0.0, probability)
            probability = torch.where(at.isnan(), torch.nan, probability)
            return probability.squeeze(-1).to(self.dtype)

        return cdf_at(right=False), cdf_at(right=True)

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Return the quantiles of λ, shape [*B, H, W]."""
        if not isinstance(probability, Tensor):
            clamped = min(max(float(probability), 0.0), 1.0)
            return self._quantile_at(clamped)
        u = probability.to(torch.float64).clamp(0, 1)
        u = u.expand(self.shape).unsqueeze(-1).contiguous()
        knots = self._knots()
        levels = self._levels()
        last = len(levels) - 1
        upper = torch.searchsorted(levels, u).clamp(1, last)
        lower = upper - 1
        low_level = levels[lower]
        fraction = (u - low_level) / (levels[upper] - low_level)
        low = knots.gather(-1, lower)
        high = knots.gather(-1, upper)
        quantiles = torch.lerp(low, high, fraction)
        return quantiles.squeeze(-1).to(self.dtype)

    def _quantile_at(self, probability: float) -> Tensor:
        index = bisect_left(self.levels, probability)
        upper = min(max(index, 1), len(self.levels) - 1)
        lower = upper - 1
        low = self.values.select(-3, lower).double()
        high = self.values.select(-3, upper).double()
        low_level = self.levels[lower]
        fraction = (probability - low_level) / (self.levels[upper] - low_level)
        return torch.lerp(low, high, fraction).to(self.dtype)

    def mean(self) -> Tensor:
        """Return E[λ], shape [*B, H, W]."""
        return self._tail_mean(1.0)

    def cvar(self, level: float) -> Tensor:
        """Return the mean of λ over its worst 1 − level fraction, shape [*B, H, W]."""
        return self._tail_mean(tail_of(level))

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """Return the CVaR of the time 1 / max(λ, floor), shape [*B, H, W]."""
        tail = tail_of(level)
        check_floor(floor)
        low, high, width = self._intervals()
        before = self._levels()[:-1]
        in_tail = ((tail - before) / width).clamp(0, 1)
        high = torch.lerp(low, high, in_tail)
        width = width * in_tail / tail
        slow = low.clamp(min=floor)
        fast = high.clamp(min=floor)
        # Below the floor, 1 / λ counts as 1 / floor. Over the remaining part [a, b] of
        # an interval, the mean of 1 / λ is log(b / a) / (b − a).
        below_floor = _fraction(floor, low, high)
        below_floor = torch.where(high <= floor, 1.0, below_floor)
        growth = (fast - slow) / slow
        exact = growth.log1p() / growth.clamp(min=1e-4)
        ratio = torch.where(growth > 1e-4, exact, 1 - growth / 2)
        time_above = (1 - below_floor) * ratio / slow
        time = below_floor / floor + time_above
        return (width * time).sum(-1).to(self.dtype)

    def crps(self, observed: Tensor) -> Tensor:
        """Return the continuous ranked probability score, shape [*B, H, W]."""
        low, high, width = self._intervals()
        levels = self._levels()
        before = levels[:-1]
        at = observed.double().unsqueeze(-1)
        split = at.clamp(low, high)
        gap = torch.where(high > low, high - low, 1.0)
        f = before + width * ((split - low) / gap)  # F at the split
        # Three times the integrals of squares of linear functions.
        below = (split - low) * (before * before + before * f + f * f)
        g = 1 - f
        last = 1 - levels[1:]
        above = (high - split) * (g * g + g * last + last * last)
        inside = (below + above).sum(-1) / 3
        over_maximum = (at - high[..., -1:]).clamp(min=0)
        under_minimum = (low[..., :1] - at).clamp(min=0)
        outside = over_maximum + under_minimum
        return (inside + outside.squeeze(-1)).to(observed.dtype)

    def _levels(self) -> Tensor:
        return torch.tensor(self.levels, dtype=torch.float64, device=self.device)

    def _knots(self) -> Tensor:
        """Return the x_i in float64, shape [*B, H, W, Q]."""
        return self.values.double().movedim(-3, -1).contiguous()

    def _intervals(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return lower ends, upper ends and probabilities of intervals between levels.

        The ends have shape [*B, H, W, Q − 1], the probabilities shape [Q − 1].
        """
        knots = self._knots()
        low = knots[..., :-1]
        high = knots[..., 1:]
        return low, high, self._levels().diff()

    def _tail_mean(self, tail: float) -> Tensor:
        """Return the mean of the quantile function over [0, tail], shape [*B, H, W].

        It is a sum of the x_i, weighted by the integrals of the hat functions with
        which the quantile function interpolates.
        """
        levels = np.array(self.levels)
        start = levels[:-1]
        ends = np.clip(levels, 0, tail)
        low = ends[:-1]
        high = ends[1:]
        squares = (high - start) ** 2 - (low - start) ** 2
        rising = squares / (2 * np.diff(levels))
        weights = np.zeros_like(levels)
        weights[1:] += rising
        weights[:-1] += (high - low) - rising
        normalised = torch.from_numpy(weights / tail).to(self.device)
        mean = torch.einsum("...qhw,q->...hw", self.values.double(), normalised)
        return mean.to(self.dtype)


def _fraction(value: Tensor | float, low: Tensor, high: Tensor) -> Tensor:
    """Return the fraction of [low, high] below a value, in [0, 1]."""
    width = torch.where(high > low, high - low, 1.0)
    return ((value - low) / width).clamp(0, 1)


def quantiles_at(
    distribution: TraversabilityDistribution,
    probabilities: Sequence[float],
    levels: tuple[float, ...] = LEVELS,
) -> QuantileDistribution:
    """Return the quantiles of a distribution at changed levels, as a distribution.

    Its quantile at `levels[i]` is the quantile of `distribution` at `probabilities[i]`.

    Args:
        distribution: distribution of shape [*B, H, W].
        probabilities: probability in `distribution` for each level, from 0 to 1, never
            descending.
        levels: levels of the result, as in `QuantileDistribution`.

    Returns:
        A distribution of shape [*B, H, W].
    """
    values = (distribution.quantile(u).clamp(0, 1) for u in probabilities)
    # Rounding may cause a small descent, which the cumulative maximum removes.
    ascending = list(accumulate(values, torch.maximum))
    return QuantileDistribution(torch.stack(ascending, -3), levels)
