"""What a prediction is: the protocol of per-cell distributions of traversability, and
all that a CDF alone gives.

λ is in [0, 1], F(x) = P(λ ≤ x) is its CDF, which jumps where λ has an atom, and Q(u) is
the least x with F(x) ≥ u. Risk is the *lower* tail of λ. A subclass says what F and Q
are and may give more in closed form; the base has all else as an integral of F:

    E[λ] = 1 − ∫₀¹ F,    CVaR_α = v − 1/p ∫₀^v F at p = 1 − α and v = Q(p),
    E[1 / max(λ, ε)] = 1 + ∫₁^{1/ε} F(1/t) dt,
    CRPS = ∫₀^y F² + ∫_y¹ (1 − F)² at an observed y.

The worst share p of λ has the CDF min(F / p, 1), which gives the CVaR of the time 1 /
max(λ, ε).

Each integrand is monotone, so that a trapezium over an interval is off by at most half
of its length times the change over it, whatever atoms and gaps are inside. The
intervals of the largest doubt are halved again and again, in each cell on its own and a
fixed number of times, and a parabola takes the place of the chord where the function is
smooth. Cells where parabolas still bow much, as with many atoms, are done again with
more halvings. All is in float64; results have the distribution's dtype.

Letters in shapes: H×W cells, *B any leading dimensions, b×h×w cells of a piece, M
nodes, S intervals.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any, Self, cast

import torch
from torch import Tensor

from benchnav.core.batch import Batch, first_tensor, map_tensors
from benchnav.core.errors import ConfigError, expect

_AT_ONCE = 4  # intervals of a cell that are halved together
_FIRST = 16  # intervals to begin with
_ROUNDS = 24
_ROUNDS_OF_TIME = 40  # which spans more than λ
_MORE = 3  # times as many rounds, for a cell with more of `_trapezia`'s doubt than this
_MOST_DOUBT = 3e-5
# of the change over an interval, which may hide a jump, beside what a parabola tells
_DOUBT = 0.1
# the change over an interval is at least so many times its bow, as of a monotone
# parabola
_MOST_BOW = 3
_CELLS_AT_ONCE = 2**13
_CELLS_ON_A_GPU = 2**18  # where few large pieces are quicker than many small ones
MOST_SCORE = 40.0  # standard deviations, beyond which Φ is 0 or 1 in float64 too


class TraversabilityDistribution(Batch, ABC):
    """The distribution of λ in each cell of a map: the base class of what models
    predict and beliefs hold.

    A subclass is a frozen dataclass whose tensors are maps, of shape [*B, H, W] or [*B,
    K, H, W] for any K, and gives `shape`, `cdf` and `quantile`. What the base makes of
    these is within 10⁻⁴, of `expected_time` relative to it (tested up to 50 atoms a
    cell), and has no gradient.
    """

    @property
    @abstractmethod
    def shape(self) -> torch.Size:
        """[*B, H, W]."""

    @property
    def dtype(self) -> torch.dtype:
        """Of the parameters, and of all that is told of λ."""
        return first_tensor(self).dtype

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return first_tensor(self).device

    @abstractmethod
    def cdf(self, value: Tensor | float) -> Tensor:
        """P(λ ≤ value), with all of an atom at the value.

        Args:
            value: traversability, a number or shape [*B, H, W].

        Returns:
            Probability, shape [*B, H, W].
        """

    @abstractmethod
    def quantile(self, probability: Tensor | float) -> Tensor:
        """Least λ that is not exceeded with this probability.

        Args:
            probability: u in [0, 1], a number or shape [*B, H, W].

        Returns:
            λ in [0, 1], shape [*B, H, W].
        """

    @property
    def searched(self) -> bool:
        """Whether quantiles are searched for, which takes long; only where no atom lies
        within (0, 1).
        """
        return False

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """P(λ < value) and P(λ ≤ value), which differ by the mass of an atom at the
        value.

        Args:
            value: traversability, a number or shape [*B, H, W].

        Returns:
            Two probabilities, each of shape [*B, H, W].
        """
        exact = torch.float64 if self.dtype == torch.float64 else torch.float32
        at = torch.as_tensor(value, dtype=exact, device=self.device)
        under = torch.nextafter(at, torch.full_like(at, -math.inf))
        return self.cdf(under), self.cdf(at)

    def mean(self) -> Tensor:
        """E[λ], shape [*B, H, W]."""

        def work(own: Self) -> Tensor:
            edges = _edges(
                torch.zeros(own.shape, dtype=torch.float64, device=own.device), 1.0
            )
            return 1 - _integral(
                own, lambda cdf, x: cdf(x), edges, own.cdf(0.0), own.cdf_limits(1.0)[0]
            )

        return self._in_pieces(work)

    def var(self, level: float) -> Tensor:
        """Value at risk: λ falls below it with probability 1 − level.

        Args:
            level: α in [0, 1); at 0 the result is 1, the supremum of λ's range.

        Returns:
            Traversability, shape [*B, H, W].
        """
        tail = tail_of(level)
        if tail == 1:
            return torch.ones(self.shape, dtype=self.dtype, device=self.device)
        return self.quantile(tail).to(self.dtype)

    def cvar(self, level: float) -> Tensor:
        """Conditional value at risk: the mean of λ over its worst share 1 − level.

        Args:
            level: α in [0, 1); at 0 the result is the mean.

        Returns:
            Traversability, shape [*B, H, W].
        """
        tail = tail_of(level)

        def work(own: Self) -> Tensor:
            value = own.quantile(tail).double()
            edges = _edges(torch.zeros_like(value), value)
            # In shares of the tail, of which F is the whole at the VaR, also where it
            # jumps beyond.
            ends = (own.cdf(0.0) / tail).clamp(max=1), torch.ones_like(value)
            share = _integral(own, lambda cdf, x: cdf(x) / tail, edges, *ends)
            return (value - share).clamp(min=0)

        return self.mean() if tail == 1 else self._in_pieces(work)

    def expected_time(self, floor: float) -> Tensor:
        """E[1 / max(λ, floor)]: the expected time over the ground, in units of its time
        at λ = 1.

        Args:
            floor: ε in (0, 1], least speed.

        Returns:
            In [1, 1 / floor], shape [*B, H, W].
        """
        return self.time_cvar(0.0, floor)

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """CVaR of the time 1 / max(λ, floor): its mean over the worst share 1 − level
        of λ, where it is least.

        Args:
            level: α in [0, 1); at 0 the result is the expected time.
            floor: ε in (0, 1], least speed.

        Returns:
            In [1, 1 / floor], shape [*B, H, W].
        """
        tail = tail_of(level)
        check_floor(floor)

        def work(own: Self) -> Tensor:
            def share(values: Tensor) -> Tensor:
                return (values / tail).clamp(max=1)

            shares = torch.linspace(
                0, 1, _FIRST + 1, dtype=torch.float64, device=own.device
            )
            edges = (floor**-shares).view(-1, 1, 1, 1).expand(-1, *own.shape)
            ends = share(own.cdf_limits(1.0)[0]), share(own.cdf(floor))
            return 1 + _integral(
                own,
                lambda cdf, times: share(cdf(1 / times)),
                edges,
                *ends,
                rounds=_ROUNDS_OF_TIME,
            )

        return self._in_pieces(work)

    def chance(self, value: float) -> Tensor:
        """P(λ ≥ value), shape [*B, H, W].

        Args:
            value: traversability in [0, 1].
        """
        return (1 - self._exact().cdf_limits(value)[0].double()).to(self.dtype)

    def spread(self) -> Tensor:
        """Half of the interval between the 16 % and the 84 % quantile of λ, shape [*B,
        H, W]: of a normal one its σ.
        """
        return (self.quantile(0.84) - self.quantile(0.16)) / 2

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density on (0, 1); log probability mass at 0 and at 1; not a number, as
        here, where there is none.

        Args:
            value: observed traversability, shape [*B, H, W].

        Returns:
            Shape [*B, H, W].
        """
        return torch.full(self.shape, math.nan, dtype=self.dtype, device=self.device)

    def crps(self, observed: Tensor) -> Tensor:
        """Continuous ranked probability score: ∫₀¹ (F(x) − 1[observed ≤ x])² dx.

        Args:
            observed: λ in [0, 1], shape [*B, H, W].

        Returns:
            Shape [*B, H, W]; 0 is perfect.
        """

        def work(own: Self, observed: Tensor) -> Tensor:
            below, at = own.cdf_limits(observed)
            edges = _edges(torch.zeros_like(observed), observed)
            ends = own.cdf(0.0).square(), below.square()
            lower = _integral(own, lambda cdf, x: cdf(x).square(), edges, *ends)
            ends = (1 - at).square(), (1 - own.cdf_limits(1.0)[0]).square()
            upper = _integral(
                own, lambda cdf, x: (1 - cdf(x)).square(), _edges(observed, 1.0), *ends
            )
            return lower + upper

        return self._in_pieces(work, observed.double().clamp(0, 1)).to(observed.dtype)

    def from_normal(self, normal: Tensor) -> Tensor:
        """λ of the rank that a standard normal number has: Q(Φ(z)).

        A field of correlated standard normals gives a field of λ with each cell's own
        distribution (a Gaussian copula).

        Args:
            normal: z, shape [*B, H, W].

        Returns:
            λ in [0, 1], shape [*B, H, W].
        """
        return self.quantile(torch.special.ndtr(normal.double())).to(self.dtype)

    def to_normal(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """The interval of standard normal numbers that `from_normal` takes to λ: Φ⁻¹ of
        P(λ < value) and P(λ ≤ value).

        Args:
            value: traversability, a number or shape [*B, H, W].

        Returns:
            Its ends, each of shape [*B, H, W]: the same where F is continuous, infinite
            where an atom reaches 0 or 1.
        """
        lower, upper = self._exact().cdf_limits(value)
        return torch.special.ndtri(lower.double()).to(self.dtype), torch.special.ndtri(
            upper.double()
        ).to(self.dtype)

    def at(self, cells: Tensor) -> Self:
        """Keeps some cells as a map of one row, [1, N].

        Args:
            cells: which of them, bool, shape [*B, H, W].
        """
        member, row, column = cells.reshape(-1, *cells.shape[-2:]).nonzero(
            as_tuple=True
        )
        return map_tensors(
            self._in_members(),
            lambda values: values.movedim(0, -3)[..., member, row, column].unsqueeze(
                -2
            ),
        )

    def differs(
        self, other: "TraversabilityDistribution", tolerance: float = 0.0
    ) -> Tensor:
        """Tells of which cells something else is predicted, bool, shape [*B, H, W].

        Args:
            other: of the same shape.
            tolerance: by how much a parameter may differ. Of distributions of other
                kinds all cells differ.
        """
        count = len(self.shape) - 2
        found = torch.zeros(self.shape, dtype=torch.bool, device=self.device)

        def note(own: Tensor, values: Tensor) -> Tensor:
            away = (own - values).abs() > tolerance
            found.logical_or_(
                away.flatten(count, -3).any(count)
                if away.ndim > len(self.shape)
                else away
            )
            return own

        if not _are_alike(self, other):
            return ~found
        map_tensors(self, note, other)
        return found

    def replaced(
        self, cells: Tensor, other: "TraversabilityDistribution"
    ) -> "TraversabilityDistribution":
        """The same with some cells, bool [*B, H, W], of another prediction, whose
        parameters are as many.
        """
        count = len(self.shape) - 2

        def put(own: Tensor, values: Tensor) -> Tensor:
            which = cells.view(
                *cells.shape[:count],
                *[1] * (own.ndim - cells.ndim),
                *cells.shape[count:],
            )
            return torch.where(which, values, own)

        found: TraversabilityDistribution = map_tensors(self, put, other)
        return found

    def class_probabilities(self, count: int) -> Tensor:
        """Probability of each of `count` terrain classes, shape [*B, count, H, W].

        Raises:
            ConfigError: the distribution knows of no classes.
        """
        raise ConfigError(self._no_classes())

    def most_likely(self) -> "TraversabilityDistribution":
        """Keeps the most likely terrain class of each cell alone: the paper's
        single-class option.

        Raises:
            ConfigError: the distribution knows of no classes.
        """
        raise ConfigError(self._no_classes())

    def _no_classes(self) -> str:
        return (
            "Expected a distribution with terrain classes for the single-class "
            f"option, got {type(self).__name__}, "
            "which has none. Take another risk measure, or a model that predicts "
            "classes."
        )

    def _exact(self) -> Self:
        """The same in float64."""
        return map_tensors(
            self,
            lambda values: values.double() if values.is_floating_point() else values,
        )

    def _in_members(self) -> Self:
        """The same with one leading dimension."""
        count = len(self.shape) - 2
        return map_tensors(
            self, lambda values: values.reshape(-1, *values.shape[count:])
        )

    def _in_pieces(self, work: Callable[..., Tensor], *layers: Tensor) -> Tensor:
        """Apply a function in chunks of cells, so that memory does not grow with the
        maps.

        Args:
            work: from a distribution of shape [b, h, w] in float64 and layers of that
                shape to numbers of that shape, each of its own cell alone.
            layers: of shape [*B, H, W].

        Returns:
            Shape [*B, H, W], in the dtype of the parameters.
        """
        with torch.no_grad():
            whole, (height, width) = self._exact()._in_members(), self.shape[-2:]
            own = [layer.reshape(-1, height, width) for layer in layers]
            size = _CELLS_AT_ONCE if self.device.type == "cpu" else _CELLS_ON_A_GPU
            members, rows = max(1, size // (height * width)), max(1, size // width)
            done = []
            for start in range(0, whole.shape[0], members):
                which = torch.arange(
                    start, min(start + members, whole.shape[0]), device=self.device
                )
                some = whole.select(which)
                done.append(
                    torch.cat(
                        [
                            work(
                                map_tensors(
                                    some,
                                    lambda values, top=top: values[
                                        ..., top : top + rows, :
                                    ],
                                ),
                                *(layer[which, top : top + rows] for layer in own),
                            )
                            for top in range(0, height, rows)
                        ],
                        dim=1,
                    )
                )
            return torch.cat(done).view(self.shape).to(self.dtype)


def _are_alike(one: Any, other: Any) -> bool:
    """Whether two predictions have parameters of the same names and shapes, and all
    else the same.
    """
    if isinstance(one, Tensor) and isinstance(other, Tensor):
        return one.shape == other.shape
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_are_alike, one, other))
    if isinstance(one, Batch) and type(one) is type(other):
        return all(
            _are_alike(getattr(one, each.name), getattr(other, each.name))
            for each in fields(cast(Any, one))
        )
    return bool(one == other)


def tail_of(level: float) -> float:
    """The share 1 − level of the tail.

    Raises:
        ConfigError: the level is outside [0, 1).
    """
    expect(
        0 <= level < 1, f"`level` in [0, 1), got {level}. CVaR at level 0 is the mean."
    )
    return 1 - float(level)


def check_floor(floor: float) -> None:
    """Refuses a least speed outside (0, 1]."""
    expect(0 < floor <= 1, f"a least speed in (0, 1], got {floor}.")


def _edges(low: Tensor, high: Tensor | float) -> Tensor:
    """Where the first intervals meet, shape [S + 1, b, h, w]."""
    shares = torch.linspace(
        0, 1, _FIRST + 1, dtype=torch.float64, device=low.device
    ).view(-1, 1, 1, 1)
    return torch.lerp(low, torch.as_tensor(high).to(low), shares)


def _stacked(own: TraversabilityDistribution) -> Callable[[Tensor], Tensor]:
    """The CDF at M values a cell, both of shape [M, b, h, w], in one call a time: more
    take as long as their work.
    """
    kept: dict[int, TraversabilityDistribution] = {}

    def cdf(values: Tensor) -> Tensor:
        count = len(values)
        if count not in kept:
            kept[count] = own.select(
                torch.arange(own.shape[0], device=own.device).repeat(count)
            )
        return kept[count].cdf(values.flatten(0, 1)).view_as(values)

    return cdf


def _integral(
    own: TraversabilityDistribution,
    curve: Callable[[Callable[[Tensor], Tensor], Tensor], Tensor],
    edges: Tensor,
    first: Tensor,
    last: Tensor,
    rounds: int = _ROUNDS,
) -> Tensor:
    """∫ of a monotone function of the CDF, in each cell by trapezia of its own.

    Args:
        own: of shape [b, h, w].
        curve: from the CDF and nodes to values, nodes and values of shape [M, b, h, w].
        edges: ascending, shape [S + 1, b, h, w].
        first: value at the first edge, shape [b, h, w].
        last: value at the last edge, shape [b, h, w].
        rounds: how often intervals are halved.

    Returns:
        Shape [b, h, w].
    """
    total, doubt = _trapezia(partial(curve, _stacked(own)), edges, first, last, rounds)
    unsure = doubt > _MOST_DOUBT
    if unsure.any():
        rest = partial(curve, _stacked(own.at(unsure)._in_members()))
        begins, low, high = (
            part[..., unsure][..., None, None, :] for part in (edges, first, last)
        )
        total[unsure] = _trapezia(rest, begins, low, high, rounds * _MORE)[0].flatten()
    return total


def _trapezia(
    function: Callable[[Tensor], Tensor],
    edges: Tensor,
    first: Tensor,
    last: Tensor,
    rounds: int,
) -> tuple[Tensor, Tensor]:
    """The integral, and its doubt, most of it of intervals with a jump in them; both of
    shape [b, h, w].
    """
    values = torch.cat((first[None], function(edges[1:-1]), last[None]))
    # A lane halves one of its intervals a time, and hands one half to the next lane, so
    # that all find work.
    filled = _FIRST // _AT_ONCE
    shape = (filled + rounds, _AT_ONCE, *first.shape)
    intervals = [values.new_empty(shape) for _ in range(6)]
    begin, width, value, rise, bow, doubt = intervals
    bow[:filled] = 0
    parts = (edges[:-1], edges.diff(dim=0), values[:-1], values.diff(dim=0))
    for layer, part in zip(intervals, parts, strict=False):
        layer[:filled] = part.view(filled, *shape[1:])
    doubt[:filled] = (rise * width)[:filled].abs()
    for new in range(filled, len(begin)):
        # several times quicker than `argmax`
        worst = doubt[:new].max(0, keepdim=True).indices
        x, whole, left, step = (layer.gather(0, worst)[0] for layer in intervals[:4])
        half = whole / 2
        middle = function(x + half)
        rises = middle - left, left + step - middle
        # What a parabola through the three has over the chord of either half, in the
        # mean.
        over = (rises[0] - rises[1]) / 12
        bows = [
            over.minimum(most).maximum(-most)
            for most in (own.abs() / _MOST_BOW for own in rises)
        ]
        doubts = [
            half * (b.abs() + _DOUBT * r.abs())
            for b, r in zip(bows, rises, strict=True)
        ]
        kept = (half, rises[0], bows[0], doubts[0])
        for layer, part in zip((width, rise, bow, doubt), kept, strict=True):
            layer.scatter_(0, worst, part[None])
        added = (x + half, half, middle, rises[1], bows[1], doubts[1])
        for layer, part in zip(intervals, added, strict=True):
            layer[new] = part.roll(1, 0)
    total = width * (value + rise / 2 + bow)
    # a jump's bow is a twelfth of it
    jumps = 12 * width * bow.square() / rise.abs().clamp(min=1e-300)
    return total.flatten(0, 1).sum(0), jumps.flatten(0, 1).sum(0)
