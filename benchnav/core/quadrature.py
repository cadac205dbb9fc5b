"""Integrals of monotone functions of a CDF, cell by cell.

The trapezium rule over an interval has an error of at most half the interval's length
times the change of the function over the interval, even if the CDF has atoms or gaps
there. In each cell, the intervals with the largest error bounds are bisected, in a
fixed number of rounds. Where the function is smooth, the area below a parabola replaces
the trapezium. Cells with a large error estimate, for example because of many atoms, are
computed again with more rounds.

Letters in shapes: b×h×w cells of a chunk; M nodes; S intervals.
"""

from collections.abc import Callable
from functools import partial
from typing import Protocol, Self

import torch
from torch import Tensor

N_INTERVALS = 16  # number of initial intervals of a cell
_N_LANES = 4  # intervals of a cell that are bisected together in a round
_ROUNDS = 24
_ROUNDS_FACTOR = 3  # factor for cells with an estimate above `_MAX_ERROR`
_MAX_ERROR = 3e-5
# An error bound includes the correction by the parabola and, since the function may
# jump within an interval, this fraction of the change over the interval.
_JUMP_FRACTION = 0.1
# The correction by a monotone parabola is at most the change over the interval divided
# by this number.
_MAX_CORRECTION_DIVISOR = 3


class _Distribution(Protocol):
    """Methods of `TraversabilityDistribution` that an integral needs."""

    @property
    def shape(self) -> torch.Size: ...

    @property
    def device(self) -> torch.device: ...

    def cdf(self, value: Tensor | float) -> Tensor: ...

    def at(self, cells: Tensor) -> Self: ...

    def select(self, members: Tensor) -> Self: ...

    def _with_flat_batch(self) -> Self: ...


def edges_between(low: Tensor, high: Tensor | float) -> Tensor:
    """Return the edges of the initial intervals, shape [S + 1, b, h, w].

    Args:
        low: first edge, shape [b, h, w].
        high: last edge, a number or shape [b, h, w].
    """
    n_edges = N_INTERVALS + 1
    steps = torch.linspace(0, 1, n_edges, dtype=torch.float64, device=low.device)
    fraction = steps.view(-1, 1, 1, 1)
    last = torch.as_tensor(high).to(low)
    return torch.lerp(low, last, fraction)


def integral(
    distribution: _Distribution,
    curve: Callable[[Callable[[Tensor], Tensor], Tensor], Tensor],
    edges: Tensor,
    first: Tensor,
    last: Tensor,
    rounds: int = _ROUNDS,
) -> Tensor:
    """Integrate a monotone function of the CDF.

    Args:
        distribution: distribution of shape [b, h, w].
        curve: monotone function of the CDF and of nodes of shape [M, b, h, w]; it
            returns values of that shape.
        edges: ascending edges of the initial intervals, shape [S + 1, b, h, w].
        first: value of `curve` at the first edge, shape [b, h, w].
        last: value of `curve` at the last edge, shape [b, h, w].
        rounds: number of rounds of bisection.

    Returns:
        Integrals, float64, shape [b, h, w].
    """
    function = partial(curve, _stacked(distribution))
    total, error = _trapezia(function, edges, first, last, rounds)
    is_inexact = error > _MAX_ERROR
    if is_inexact.any():
        inexact = distribution.at(is_inexact)._with_flat_batch()
        function = partial(curve, _stacked(inexact))
        # The inexact cells become a map of one row.
        edges, first, last = (
            values[..., is_inexact][..., None, None, :]
            for values in (edges, first, last)
        )
        more_rounds = rounds * _ROUNDS_FACTOR
        refined, _ = _trapezia(function, edges, first, last, more_rounds)
        total[is_inexact] = refined.flatten()
    return total


def _stacked(
    distribution: _Distribution,
) -> Callable[[Tensor], Tensor]:
    """Return the CDF as a function of M values per cell.

    Argument and result have the shape [M, b, h, w]. The distribution is repeated M
    times, so that a single call computes all values.
    """
    cache: dict[int, _Distribution] = {}

    def cdf(values: Tensor) -> Tensor:
        count = len(values)
        if count not in cache:
            indices = torch.arange(distribution.shape[0], device=distribution.device)
            cache[count] = distribution.select(indices.repeat(count))
        probabilities = cache[count].cdf(values.flatten(0, 1))
        return probabilities.view_as(values)

    return cdf


def _trapezia(
    function: Callable[[Tensor], Tensor],
    edges: Tensor,
    first: Tensor,
    last: Tensor,
    rounds: int,
) -> tuple[Tensor, Tensor]:
    """Return integrals and their error estimates, both of shape [b, h, w].

    The estimate assumes that the error is due to jumps within the final intervals.
    """
    inner_values = function(edges[1:-1])
    values = torch.cat((first[None], inner_values, last[None]))
    # The intervals of a cell are divided into lanes. A lane bisects one of its
    # intervals per round and passes one half to the next lane, so that each lane has
    # intervals with large error bounds.
    n_filled = N_INTERVALS // _N_LANES
    lane_shape = _N_LANES, *first.shape
    shape = (n_filled + rounds, *lane_shape)
    intervals = [values.new_empty(shape) for _ in range(6)]
    begin, width, value, rise, correction, bound = intervals
    correction[:n_filled] = 0
    initial = (edges[:-1], edges.diff(dim=0), values[:-1], values.diff(dim=0))
    for layer, part in zip(intervals, initial, strict=False):
        layer[:n_filled] = part.view(n_filled, *lane_shape)
    bound[:n_filled] = (rise * width)[:n_filled].abs()
    for new in range(n_filled, len(begin)):
        # `max` is several times faster than `argmax`.
        worst = bound[:new].max(0, keepdim=True).indices
        old_begin, old_width, old_value, old_rise = (
            layer.gather(0, worst)[0] for layer in intervals[:4]
        )
        half = old_width / 2
        centre = old_begin + half
        middle = function(centre)
        left_rise = middle - old_value
        right_rise = old_value + old_rise - middle
        # Mean difference between the parabola through the three points and the chord,
        # in either half.
        mean_excess = (left_rise - right_rise) / 12
        left_correction = _limited(mean_excess, left_rise)
        right_correction = _limited(mean_excess, right_rise)
        left_bound = _bound(half, left_correction, left_rise)
        right_bound = _bound(half, right_correction, right_rise)
        left_half = (half, left_rise, left_correction, left_bound)
        changed = (width, rise, correction, bound)
        for layer, part in zip(changed, left_half, strict=True):
            layer.scatter_(0, worst, part[None])
        right_half = (centre, half, middle, right_rise, right_correction, right_bound)
        for layer, part in zip(intervals, right_half, strict=True):
            layer[new] = part.roll(1, 0)
    mean_value = value + rise / 2 + correction
    areas = width * mean_value
    # In an interval with a jump, the correction is a twelfth of the rise.
    abs_rise = rise.abs().clamp(min=1e-300)
    errors = 12 * width * correction.square() / abs_rise
    total = areas.flatten(0, 1).sum(0)
    total_error = errors.flatten(0, 1).sum(0)
    return total, total_error


def _limited(excess: Tensor, rise: Tensor) -> Tensor:
    """Return a correction, limited to the maximum of a monotone parabola."""
    limit = rise.abs() / _MAX_CORRECTION_DIVISOR
    return excess.minimum(limit).maximum(-limit)


def _bound(width: Tensor, correction: Tensor, rise: Tensor) -> Tensor:
    jump = _JUMP_FRACTION * rise.abs()
    return width * (correction.abs() + jump)
