"""Distributions by their quantiles, as quantile regression gives them: piecewise
linear, with exact integrals.

Q is linear between levels u_i, at which it is x_i. Where it is flat, λ has an atom;
where it is steep, F is nearly so. Mean, VaR and CVaR are then weighted sums of the x_i,
and the expected time and the CRPS are sums over intervals.
Letters in shapes: Q levels, H×W cells, *B any leading dimensions.
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

_LEAST_LEVELS = 64
_TAIL, _TAIL_STEP = 0.1, 0.01  # under which level the steps are to be how small

LEVELS: tuple[float, ...] = (
    *(0.0, 0.001, 0.002, 0.003, 0.005, 0.0075),
    *(round(0.01 + 0.005 * step, 3) for step in range(18)),
    *(round(0.1 + 0.02 * step, 2) for step in range(45)),
    *(0.99, 0.995, 1.0),
)
"""Levels that serve a model that needs none of its own: 72, a third of them up to 0.1,
where risk is.
"""


@dataclass(frozen=True)
class QuantileDistribution(TraversabilityDistribution):
    """Quantiles of λ in each cell, linear in between.

    Args:
        values: λ at the levels, ascending and in [0, 1], shape [*B, Q, H, W]. Several
            levels of one value are an atom.
        levels: ascending from 0, the least λ, to 1, the greatest: 64 or more, and up to
            0.1 no more than 0.01 apart.

    Raises:
        ConfigError: the levels are others, or the shape does not fit them.
    """

    values: Tensor
    levels: tuple[float, ...] = LEVELS

    def __post_init__(self) -> None:
        """Checks the levels and the shape; that values ascend takes a look at all of
        them, which `check_model` does.
        """
        # plain numbers: PyTorch, as it writes a graph, would follow an array
        levels = self.levels
        steps = [upper - lower for lower, upper in pairwise(levels)]
        expect(
            len(levels) >= _LEAST_LEVELS
            and levels[0] == 0
            and levels[-1] == 1
            and min(steps) > 0,
            f"`levels` that ascend from 0 to 1, {_LEAST_LEVELS} or more, got "
            f"{len(levels)}. "
            "`benchnav.core.quantiles.LEVELS` are such.",
        )
        widest = max(
            step
            for step, lower in zip(steps, levels, strict=False)
            if lower < _TAIL - 1e-9
        )
        expect(
            widest <= _TAIL_STEP + 1e-9,
            f"`levels` at most {_TAIL_STEP} apart up to {_TAIL}, where risk is, got "
            f"{widest:.3g}. Take more there.",
        )
        if self.values.ndim < 3 or self.values.shape[-3] != len(levels):
            raise ConfigError(
                f"Expected `values` of shape [*B, {len(levels)}, H, W], one map a "
                f"level, got {list(self.values.shape)}."
            )

    @property
    def shape(self) -> torch.Size:
        """[*B, H, W]."""
        return self.values.select(-3, 0).shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """P(λ ≤ value), shape [*B, H, W]; see the base."""
        return self.cdf_limits(value)[1]

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """P(λ < value) and P(λ ≤ value), each of shape [*B, H, W]; see the base."""
        at = (
            torch.as_tensor(value, dtype=torch.float64, device=self.device)
            .expand(self.shape)
            .unsqueeze(-1)
        )
        knots, levels = self._knots(), self._levels()

        def share(right: bool) -> Tensor:
            after = torch.searchsorted(knots, at.contiguous(), right=right)
            upper, lower = after.clamp(max=len(levels) - 1), (after - 1).clamp(min=0)
            low, high = knots.gather(-1, lower), knots.gather(-1, upper)
            part = ((at - low) / torch.where(high > low, high - low, 1.0)).clamp(0, 1)
            inside = torch.lerp(levels[lower], levels[upper], part)
            inside = torch.where(
                after == 0, 0.0, torch.where(after == len(levels), 1.0, inside)
            )
            return torch.where(at.isnan(), torch.nan, inside).squeeze(-1).to(self.dtype)

        return share(right=False), share(right=True)

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Least λ that is not exceeded with this probability, shape [*B, H, W]; see the
        base.
        """
        if not isinstance(probability, Tensor):
            plain = min(max(float(probability), 0.0), 1.0)
            after = min(max(bisect_left(self.levels, plain), 1), len(self.levels) - 1)
            before, behind = self.levels[after - 1 : after + 1]
            low, high = (
                self.values.select(-3, place).double() for place in (after - 1, after)
            )
            return torch.lerp(low, high, (plain - before) / (behind - before)).to(
                self.dtype
            )
        share = probability.to(torch.float64).clamp(0, 1)
        knots, levels = self._knots(), self._levels()
        at = share.expand(self.shape).unsqueeze(-1).contiguous()
        upper = torch.searchsorted(levels, at).clamp(1, len(levels) - 1)
        part = (at - levels[upper - 1]) / (levels[upper] - levels[upper - 1])
        found = torch.lerp(knots.gather(-1, upper - 1), knots.gather(-1, upper), part)
        return found.squeeze(-1).to(self.dtype)

    def mean(self) -> Tensor:
        """E[λ], shape [*B, H, W]."""
        return self._mean_under(1.0)

    def cvar(self, level: float) -> Tensor:
        """Mean of λ over its worst share 1 − level, shape [*B, H, W]; see the base."""
        return self._mean_under(tail_of(level))

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """CVaR of the time 1 / max(λ, floor), shape [*B, H, W]; see the base."""
        tail = tail_of(level)
        check_floor(floor)
        low, high, width = self._intervals()
        # of each interval, that is in the tail
        part = ((tail - self._levels()[:-1]) / width).clamp(0, 1)
        high, width = torch.lerp(low, high, part), width * part / tail
        slow, fast = low.clamp(min=floor), high.clamp(min=floor)
        # Of an interval this share is under the floor, and 1 / λ has the mean log(b /
        # a) / (b − a) over the rest.
        under = ((floor - low) / torch.where(high > low, high - low, 1.0)).clamp(0, 1)
        under = torch.where(high <= floor, 1.0, under)
        growth = (fast - slow) / slow
        ratio = torch.where(
            growth > 1e-4, growth.log1p() / growth.clamp(min=1e-4), 1 - growth / 2
        )
        return (
            (width * (under / floor + (1 - under) * ratio / slow))
            .sum(-1)
            .to(self.dtype)
        )

    def crps(self, observed: Tensor) -> Tensor:
        """Continuous ranked probability score, shape [*B, H, W]; see the base."""
        low, high, width = self._intervals()
        levels, at = self._levels(), observed.double().unsqueeze(-1)
        before, after, split = levels[:-1], levels[1:], at.clamp(low, high)
        share = before + width * (
            (split - low) / torch.where(high > low, high - low, 1.0)
        )
        below = (split - low) * (before * before + before * share + share * share)
        rest, last = 1 - share, 1 - after
        above = (high - split) * (rest * rest + rest * last + last * last)
        outside = (at - high[..., -1:]).clamp(min=0) + (low[..., :1] - at).clamp(min=0)
        return ((below + above).sum(-1) / 3 + outside.squeeze(-1)).to(observed.dtype)

    def _levels(self) -> Tensor:
        return torch.tensor(self.levels, dtype=torch.float64, device=self.device)

    def _knots(self) -> Tensor:
        """x_i in float64, shape [*B, H, W, Q]."""
        return self.values.double().movedim(-3, -1).contiguous()

    def _intervals(self) -> tuple[Tensor, Tensor, Tensor]:
        """λ at the ends of the intervals, shape [*B, H, W, Q − 1], and how much
        probability each has, [Q − 1].
        """
        knots = self._knots()
        return knots[..., :-1], knots[..., 1:], self._levels().diff()

    def _mean_under(self, tail: float) -> Tensor:
        """The mean of Q over [0, tail], shape [*B, H, W]: a sum of the x_i by ∫ of the
        hat function of each.
        """
        levels = np.array(self.levels)
        ends = np.clip(levels, 0, tail)
        low, high, step = ends[:-1], ends[1:], np.diff(levels)
        rising = ((high - levels[:-1]) ** 2 - (low - levels[:-1]) ** 2) / (2 * step)
        weights = np.zeros_like(levels)
        weights[1:] += rising
        weights[:-1] += (high - low) - rising
        shares = torch.from_numpy(weights / tail).to(self.device)
        return torch.einsum("...qhw,q->...hw", self.values.double(), shares).to(
            self.dtype
        )


def quantiles_at(
    distribution: TraversabilityDistribution,
    reads: Sequence[float],
    levels: tuple[float, ...] = LEVELS,
) -> QuantileDistribution:
    """Moves the quantiles of a distribution to other levels.

    Args:
        distribution: of shape [*B, H, W].
        reads: at which of its own levels the quantiles are read, ascending from 0 to 1,
            one a level.
        levels: which they are to have; see `QuantileDistribution`.

    Returns:
        Of shape [*B, H, W].
    """
    values = (distribution.quantile(read).clamp(0, 1) for read in reads)
    # rounding may have changed the order
    ascending = list(accumulate(values, torch.maximum))
    return QuantileDistribution(torch.stack(ascending, -3), levels)
