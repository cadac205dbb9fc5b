"""Base class of distributions of traversability λ in each cell of a map.

λ is in [0, 1]; F(x) = P(λ ≤ x) is its CDF, which jumps where λ has an atom; Q(u) is the
smallest x with F(x) ≥ u. Risk is the *lower* tail of λ. A subclass defines F and Q, and
may have other functions in closed form. The base computes them as integrals of F:

    E[λ] = 1 − ∫₀¹ F
    CVaR_α = v − 1/p ∫₀^v F  at p = 1 − α and v = Q(p)
    E[1 / max(λ, ε)] = 1 + ∫₁^{1/ε} F(1/t) dt
    CRPS = ∫₀^y F² + ∫_y¹ (1 − F)²  at an observed y

The worst fraction p of λ has the CDF min(F / p, 1), from which the CVaR of the time
1 / max(λ, ε) follows. Integrals are computed in float64 by `benchnav.core.quadrature`;
results have the distribution's dtype.

Letters in shapes: H×W cells; *B any leading dimensions; b×h×w cells of a chunk.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import fields
from typing import Any, Self, cast

import torch
from torch import Tensor

from benchnav.core.batch import Batch, first_tensor, map_tensors, tensors_of
from benchnav.core.errors import ConfigError, expect
from benchnav.core.quadrature import N_INTERVALS, edges_between, integral

_ROUNDS_OF_TIME = 40  # bisections; times span a larger range than λ
_CELLS_AT_ONCE = 2**13
_CELLS_ON_A_GPU = 2**18  # on a GPU, few large chunks are faster than many small ones
MAX_SCORE = 40.0  # standard deviations; beyond, Φ is 0 or 1 in float64


class TraversabilityDistribution(Batch, ABC):
    """The distribution of λ in each cell of a map, as in predictions and beliefs.

    A subclass is a frozen dataclass whose tensors are maps, of shape [*B, H, W] or
    [*B, K, H, W] for any K, and implements `shape`, `cdf` and `quantile`. The integrals
    of the base are within 10⁻⁴, that of `expected_time` relative to its value (tested
    with up to 50 atoms per cell), and have no gradient.
    """

    @property
    @abstractmethod
    def shape(self) -> torch.Size:
        """[*B, H, W]."""

    @property
    def dtype(self) -> torch.dtype:
        """Data type of parameters and results."""
        return first_tensor(self).dtype

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return first_tensor(self).device

    @abstractmethod
    def cdf(self, value: Tensor | float) -> Tensor:
        """Return P(λ ≤ value), which includes an atom at the value.

        Args:
            value: traversability, a number or shape [*B, H, W].

        Returns:
            Probability, shape [*B, H, W].
        """

    @abstractmethod
    def quantile(self, probability: Tensor | float) -> Tensor:
        """Return the smallest x with P(λ ≤ x) ≥ probability.

        Args:
            probability: u in [0, 1], a number or shape [*B, H, W].

        Returns:
            λ in [0, 1], shape [*B, H, W].
        """

    @property
    def searched(self) -> bool:
        """Whether quantiles are found by a slow search, without atoms in (0, 1)."""
        return False

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return P(λ < value) and P(λ ≤ value), which differ by the atom at the value.

        Args:
            value: traversability, a number or shape [*B, H, W].

        Returns:
            Two probabilities, each of shape [*B, H, W].
        """
        exact = torch.float64 if self.dtype == torch.float64 else torch.float32
        at = torch.as_tensor(value, dtype=exact, device=self.device)
        below = torch.nextafter(at, torch.full_like(at, -math.inf))
        return self.cdf(below), self.cdf(at)

    def mean(self) -> Tensor:
        """Return E[λ], shape [*B, H, W]."""

        def compute(chunk: Self) -> Tensor:
            zeros = torch.zeros(chunk.shape, dtype=torch.float64, device=chunk.device)
            edges = edges_between(zeros, 1.0)
            ends = chunk.cdf(0.0), chunk.cdf_limits(1.0)[0]
            return 1 - integral(chunk, lambda cdf, x: cdf(x), edges, *ends)

        return self._in_chunks(compute)

    def var(self, level: float) -> Tensor:
        """Return the value at risk: λ is below it with probability 1 − level.

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
        """Return the conditional value at risk: E[λ] over its worst 1 − level fraction.

        Args:
            level: α in [0, 1); at 0 the result is the mean.

        Returns:
            Traversability, shape [*B, H, W].
        """
        tail = tail_of(level)

        def compute(chunk: Self) -> Tensor:
            value = chunk.quantile(tail).double()
            edges = edges_between(torch.zeros_like(value), value)
            # F / tail is 1 at the VaR, even if F jumps beyond the tail there.
            ends = (chunk.cdf(0.0) / tail).clamp(max=1), torch.ones_like(value)
            shortfall = integral(chunk, lambda cdf, x: cdf(x) / tail, edges, *ends)
            return (value - shortfall).clamp(min=0)

        return self.mean() if tail == 1 else self._in_chunks(compute)

    def expected_time(self, floor: float) -> Tensor:
        """Return E[1 / max(λ, floor)], the expected time relative to that at λ = 1.

        Args:
            floor: minimum speed ε, in (0, 1].

        Returns:
            Values in [1, 1 / floor], shape [*B, H, W].
        """
        return self.time_cvar(0.0, floor)

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """Return the CVaR of the time 1 / max(λ, floor).

        It is the mean over the worst 1 − level fraction of λ.

        Args:
            level: α in [0, 1); at 0 the result is the expected time.
            floor: minimum speed ε, in (0, 1].

        Returns:
            Values in [1, 1 / floor], shape [*B, H, W].
        """
        tail = tail_of(level)
        check_floor(floor)

        def in_tail(probabilities: Tensor) -> Tensor:
            return (probabilities / tail).clamp(max=1)

        def compute(chunk: Self) -> Tensor:
            exponents = torch.linspace(
                0, 1, N_INTERVALS + 1, dtype=torch.float64, device=chunk.device
            )
            times = (floor**-exponents).view(-1, 1, 1, 1).expand(-1, *chunk.shape)
            return 1 + integral(
                chunk,
                lambda cdf, time: in_tail(cdf(1 / time)),
                times,
                in_tail(chunk.cdf_limits(1.0)[0]),
                in_tail(chunk.cdf(floor)),
                rounds=_ROUNDS_OF_TIME,
            )

        return self._in_chunks(compute)

    def chance(self, value: float) -> Tensor:
        """Return the exceedance probability P(λ ≥ value), shape [*B, H, W].

        Args:
            value: traversability in [0, 1].
        """
        return (1 - self._exact().cdf_limits(value)[0].double()).to(self.dtype)

    def spread(self) -> Tensor:
        """Return half the distance of the 16 % and 84 % quantiles, shape [*B, H, W].

        For a normal distribution it is σ.
        """
        return (self.quantile(0.84) - self.quantile(0.16)) / 2

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log density on (0, 1) and log probability mass at 0 and at 1.

        Args:
            value: observed traversability, shape [*B, H, W].

        Returns:
            Values of shape [*B, H, W], NaN where there is no density; here, everywhere.
        """
        return torch.full(self.shape, math.nan, dtype=self.dtype, device=self.device)

    def crps(self, observed: Tensor) -> Tensor:
        """Return the continuous ranked probability score ∫₀¹ (F(x) − 1[y ≤ x])² dx.

        Args:
            observed: observed λ y in [0, 1], shape [*B, H, W].

        Returns:
            Scores of shape [*B, H, W]; 0 is perfect.
        """

        def compute(chunk: Self, observed: Tensor) -> Tensor:
            below, at = chunk.cdf_limits(observed)
            edges = edges_between(torch.zeros_like(observed), observed)
            ends = chunk.cdf(0.0).square(), below.square()
            lower = integral(chunk, lambda cdf, x: cdf(x).square(), edges, *ends)
            edges = edges_between(observed, 1.0)
            ends = (1 - at).square(), (1 - chunk.cdf_limits(1.0)[0]).square()
            upper = integral(chunk, lambda cdf, x: (1 - cdf(x)).square(), edges, *ends)
            return lower + upper

        scores = self._in_chunks(compute, observed.double().clamp(0, 1))
        return scores.to(observed.dtype)

    def from_normal(self, normal: Tensor) -> Tensor:
        """Return λ of standard normal scores, Q(Φ(z)).

        A field of correlated standard normals becomes a λ field whose marginals are the
        distributions of the cells (a Gaussian copula).

        Args:
            normal: z, shape [*B, H, W].

        Returns:
            λ in [0, 1], shape [*B, H, W].
        """
        return self.quantile(torch.special.ndtr(normal.double())).to(self.dtype)

    def to_normal(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return the interval of standard normal scores that `from_normal` maps to λ.

        Its ends are Φ⁻¹ of P(λ < value) and P(λ ≤ value).

        Args:
            value: traversability, a number or shape [*B, H, W].

        Returns:
            Both ends, each of shape [*B, H, W]: equal where F is continuous, infinite
            where an atom is at 0 or 1.
        """
        lower, upper = self._exact().cdf_limits(value)
        lower_score = torch.special.ndtri(lower.double()).to(self.dtype)
        return lower_score, torch.special.ndtri(upper.double()).to(self.dtype)

    def at(self, cells: Tensor) -> Self:
        """Return the distribution of N selected cells as a map of one row, [1, N].

        Args:
            cells: mask of the cells, bool, shape [*B, H, W].
        """
        flat = cells.reshape(-1, *cells.shape[-2:])
        member, row, column = flat.nonzero(as_tuple=True)

        def select(values: Tensor) -> Tensor:
            return values.movedim(0, -3)[..., member, row, column].unsqueeze(-2)

        return map_tensors(self._in_members(), select)

    def differs(
        self, other: "TraversabilityDistribution", tolerance: float = 0.0
    ) -> Tensor:
        """Return a mask of cells whose parameters differ, bool, shape [*B, H, W].

        Args:
            other: distribution of the same shape; if it is of another kind, all cells
                differ.
            tolerance: tolerance of the parameters.
        """
        n_batch = len(self.shape) - 2
        changed = torch.zeros(self.shape, dtype=torch.bool, device=self.device)
        if not _are_alike(self, other):
            return ~changed
        for first, second in zip(tensors_of(self), tensors_of(other), strict=True):
            exceeds = (first - second).abs() > tolerance
            if exceeds.ndim > len(self.shape):  # has a component dimension
                exceeds = exceeds.flatten(n_batch, -3).any(n_batch)
            changed |= exceeds
        return changed

    def replaced(
        self, cells: Tensor, other: "TraversabilityDistribution"
    ) -> "TraversabilityDistribution":
        """Return the distribution with selected cells of another.

        Args:
            cells: mask of the cells, bool, shape [*B, H, W].
            other: distribution with parameters of the same shapes.
        """
        n_batch = len(self.shape) - 2

        def put(old: Tensor, new: Tensor) -> Tensor:
            components = [1] * (old.ndim - cells.ndim)
            batch, map_shape = cells.shape[:n_batch], cells.shape[n_batch:]
            return torch.where(cells.view(*batch, *components, *map_shape), new, old)

        result: TraversabilityDistribution = map_tensors(self, put, other)
        return result

    def class_probabilities(self, count: int) -> Tensor:
        """Return probabilities of `count` terrain classes, shape [*B, count, H, W].

        Raises:
            ConfigError: If the distribution has no classes.
        """
        raise ConfigError(self._no_classes())

    def most_likely(self) -> "TraversabilityDistribution":
        """Return the distribution given the most likely terrain class of each cell.

        This is the single-class option of the paper.

        Raises:
            ConfigError: If the distribution has no classes.
        """
        raise ConfigError(self._no_classes())

    def _no_classes(self) -> str:
        return (
            "Expected a distribution with terrain classes for the single-class "
            f"option, got {type(self).__name__}, which has none. Take another risk "
            "measure, or a model that predicts classes."
        )

    def _exact(self) -> Self:
        """Return the distribution in float64."""
        return map_tensors(
            self,
            lambda values: values.double() if values.is_floating_point() else values,
        )

    def _in_members(self) -> Self:
        """Return the distribution with a single leading dimension."""
        n_batch = len(self.shape) - 2
        return map_tensors(
            self, lambda values: values.reshape(-1, *values.shape[n_batch:])
        )

    def _in_chunks(self, compute: Callable[..., Tensor], *layers: Tensor) -> Tensor:
        """Apply a function in chunks of cells, to limit memory.

        Args:
            compute: function of a distribution of shape [b, h, w] in float64 and layers
                of that shape; returns values of that shape, each of its cell only.
            layers: further arguments, each of shape [*B, H, W].

        Returns:
            Values of shape [*B, H, W], in the dtype of the parameters.
        """
        with torch.no_grad():
            flat = self._exact()._in_members()
            height, width = self.shape[-2:]
            flat_layers = [layer.reshape(-1, height, width) for layer in layers]
            size = _CELLS_AT_ONCE if self.device.type == "cpu" else _CELLS_ON_A_GPU
            n_members = max(1, size // (height * width))
            n_rows = max(1, size // width)
            results = []
            for start in range(0, flat.shape[0], n_members):
                stop = min(start + n_members, flat.shape[0])
                members = torch.arange(start, stop, device=self.device)
                maps = flat.select(members)
                rows = []
                for top in range(0, height, n_rows):
                    band = slice(top, top + n_rows)
                    chunk = map_tensors(maps, lambda values, b=band: values[..., b, :])
                    chunk_layers = [layer[members, band] for layer in flat_layers]
                    rows.append(compute(chunk, *chunk_layers))
                results.append(torch.cat(rows, dim=1))
            return torch.cat(results).view(self.shape).to(self.dtype)


def _are_alike(first: Any, second: Any) -> bool:
    """Return whether two predictions are equal except for values of tensors."""
    if isinstance(first, Tensor) and isinstance(second, Tensor):
        return first.shape == second.shape
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(map(_are_alike, first, second))
    if isinstance(first, Batch) and type(first) is type(second):
        return all(
            _are_alike(getattr(first, field.name), getattr(second, field.name))
            for field in fields(cast(Any, first))
        )
    return bool(first == second)


def tail_of(level: float) -> float:
    """Return the probability 1 − level of the tail.

    Raises:
        ConfigError: If the level is outside [0, 1).
    """
    expect(
        0 <= level < 1, f"`level` in [0, 1), got {level}. CVaR at level 0 is the mean."
    )
    return 1 - float(level)


def check_floor(floor: float) -> None:
    """Validate a minimum speed.

    Raises:
        ConfigError: If it is outside (0, 1].
    """
    expect(0 < floor <= 1, f"a minimum speed in (0, 1], got {floor}.")
