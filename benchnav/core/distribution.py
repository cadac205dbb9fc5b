"""Base class of distributions of traversability λ in each cell of a map.

λ is in [0, 1]; F(x) = P(λ ≤ x) is its CDF, which jumps where λ has an atom; Q(u) is the
smallest x with F(x) ≥ u. Risk is the *lower* tail of λ. A subclass defines F and Q. The
base class computes other quantities as integrals of F, unless a subclass overrides them:

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
from functools import partial
from typing import Self

import torch
from torch import Tensor

from benchnav.core.batch import (
    Batch,
    first_tensor,
    have_same_structure,
    map_tensors,
    tensors_of,
)
from benchnav.core.errors import ConfigError, expect
from benchnav.core.quadrature import N_INTERVALS, edges_between, integral

_ROUNDS_FOR_TIMES = 40  # bisections; times span a larger range than λ
_CHUNK_CELLS_ON_CPU = 2**13
_CHUNK_CELLS_ON_GPU = 2**18  # larger, since few large chunks are faster on a GPU
MAX_SCORE = 40.0  # standard normal score beyond which Φ is 0 or 1 in float64


class TraversabilityDistribution(Batch, ABC):
    """The distribution of λ in each cell of a map, as in predictions and beliefs.

    A subclass is a frozen dataclass whose tensors are maps, of shape [*B, H, W] or
    [*B, K, H, W] for any K, and implements `shape`, `cdf` and `quantile`. The integrals
    of this base class have errors of at most 10⁻⁴, as tested with up to 50 atoms per
    cell. The error of expected times is relative. The integrals have no gradient.
    """

    @property
    @abstractmethod
    def shape(self) -> torch.Size:
        """Shape of the maps, [*B, H, W]."""

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
        """Whether `quantile` is a slow search, and λ has no atoms in (0, 1)."""
        return False

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return P(λ < value) and P(λ ≤ value), which differ by the atom at the value.

        Args:
            value: traversability, a number or shape [*B, H, W].

        Returns:
            Two probabilities, each of shape [*B, H, W].
        """
        dtype = torch.float64 if self.dtype == torch.float64 else torch.float32
        at = torch.as_tensor(value, dtype=dtype, device=self.device)
        minus_infinity = torch.full_like(at, -math.inf)
        below = torch.nextafter(at, minus_infinity)
        return self.cdf(below), self.cdf(at)

    def mean(self) -> Tensor:
        """Return E[λ], shape [*B, H, W]."""

        def compute(chunk: Self) -> Tensor:
            zeros = torch.zeros(chunk.shape, dtype=torch.float64, device=chunk.device)
            edges = edges_between(zeros, 1.0)
            first = chunk.cdf(0.0)
            last = chunk.cdf_limits(1.0)[0]
            return 1 - integral(chunk, lambda cdf, x: cdf(x), edges, first, last)

        return self._in_chunks(compute)

    def var(self, level: float) -> Tensor:
        """Return the value at risk: λ is below it with probability 1 − level.

        Args:
            level: α in [0, 1); at 0 the result is 1, the upper end of λ's range.

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
        if tail == 1:
            return self.mean()

        def compute(chunk: Self) -> Tensor:
            value = chunk.quantile(tail).double()
            edges = edges_between(torch.zeros_like(value), value)
            first = (chunk.cdf(0.0) / tail).clamp(max=1)
            # F / tail counts as 1 at the VaR, even if F jumps above `tail` there.
            last = torch.ones_like(value)
            shortfall = integral(
                chunk, lambda cdf, x: cdf(x) / tail, edges, first, last
            )
            return (value - shortfall).clamp(min=0)

        return self._in_chunks(compute)

    def expected_time(self, floor: float) -> Tensor:
        """Return E[1 / max(λ, floor)], the expected time relative to time at λ = 1.

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

        def cdf_of_time(cdf: Callable[[Tensor], Tensor], time: Tensor) -> Tensor:
            return in_tail(cdf(1 / time))

        def compute(chunk: Self) -> Tensor:
            exponents = torch.linspace(
                0, 1, N_INTERVALS + 1, dtype=torch.float64, device=chunk.device
            )
            times = (floor**-exponents).view(-1, 1, 1, 1).expand(-1, *chunk.shape)
            first = in_tail(chunk.cdf_limits(1.0)[0])
            last = in_tail(chunk.cdf(floor))
            rounds = _ROUNDS_FOR_TIMES
            return 1 + integral(chunk, cdf_of_time, times, first, last, rounds)

        return self._in_chunks(compute)

    def chance(self, value: float) -> Tensor:
        """Return the exceedance probability P(λ ≥ value), shape [*B, H, W].

        Args:
            value: traversability in [0, 1].
        """
        below = self._in_float64().cdf_limits(value)[0].double()
        return (1 - below).to(self.dtype)

    def spread(self) -> Tensor:
        """Return half the difference of the 84 % and 16 % quantiles, shape [*B, H, W].

        For a normal distribution, this is σ.
        """
        high = self.quantile(0.84)
        low = self.quantile(0.16)
        return (high - low) / 2

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log density on (0, 1) and log probability mass at 0 and at 1.

        Args:
            value: observed traversability, shape [*B, H, W].

        Returns:
            Values of shape [*B, H, W]; NaN if a subclass defines no density.
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
            first = chunk.cdf(0.0).square()
            last = below.square()
            lower = integral(chunk, lambda cdf, x: cdf(x).square(), edges, first, last)
            edges = edges_between(observed, 1.0)
            first = (1 - at).square()
            last = (1 - chunk.cdf_limits(1.0)[0]).square()
            upper = integral(
                chunk, lambda cdf, x: (1 - cdf(x)).square(), edges, first, last
            )
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
        rank = torch.special.ndtr(normal.double())
        return self.quantile(rank).to(self.dtype)

    def to_normal(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return the interval of standard normal scores that `from_normal` maps to λ.

        Its ends are Φ⁻¹ of P(λ < value) and P(λ ≤ value).

        Args:
            value: traversability λ, a number or shape [*B, H, W].

        Returns:
            Both ends, each of shape [*B, H, W]; equal if F is continuous at the value.
            The lower end is −∞ for λ = 0, and the upper end is ∞ for λ = 1.
        """
        lower, upper = self._in_float64().cdf_limits(value)
        lower_score = torch.special.ndtri(lower.double())
        upper_score = torch.special.ndtri(upper.double())
        return lower_score.to(self.dtype), upper_score.to(self.dtype)

    def at(self, cells: Tensor) -> Self:
        """Return the distribution of N selected cells as a map of one row, [1, N].

        Args:
            cells: mask of the cells, bool, shape [*B, H, W].
        """
        flat = cells.reshape(-1, *cells.shape[-2:])
        map_index, row, column = flat.nonzero(as_tuple=True)

        def select(values: Tensor) -> Tensor:
            maps = values.movedim(0, -3)
            return maps[..., map_index, row, column].unsqueeze(-2)

        return map_tensors(self._with_flat_batch(), select)

    def differs(
        self, distribution: "TraversabilityDistribution", tolerance: float = 0.0
    ) -> Tensor:
        """Return a mask of cells whose parameters differ, bool, shape [*B, H, W].

        Args:
            distribution: distribution of the same shape. If its class or its number of
                components differs, all cells differ.
            tolerance: maximum difference of parameters that count as equal, ≥ 0.
        """
        n_batch = len(self.shape) - 2
        changed = torch.zeros(self.shape, dtype=torch.bool, device=self.device)
        if not have_same_structure(self, distribution):
            return ~changed
        pairs = zip(tensors_of(self), tensors_of(distribution), strict=True)
        for first, second in pairs:
            exceeds = (first - second).abs() > tolerance
            if exceeds.ndim > len(self.shape):  # has a component dimension
                exceeds = exceeds.flatten(n_batch, -3).any(n_batch)
            changed |= exceeds
        return changed

    def replaced(
        self, cells: Tensor, replacement: "TraversabilityDistribution"
    ) -> "TraversabilityDistribution":
        """Return the distribution with selected cells replaced.

        Args:
            cells: mask of the cells to replace, bool, shape [*B, H, W].
            replacement: distribution of the new cells, with parameters of equal shapes.
        """
        n_batch = len(self.shape) - 2
        batch_shape = cells.shape[:n_batch]
        map_shape = cells.shape[n_batch:]

        def put(old: Tensor, new: Tensor) -> Tensor:
            components = [1] * (old.ndim - cells.ndim)
            mask = cells.view(*batch_shape, *components, *map_shape)
            return torch.where(mask, new, old)

        result: TraversabilityDistribution = map_tensors(self, put, replacement)
        return result

    def class_probabilities(self, count: int) -> Tensor:
        """Return probabilities of `count` terrain classes, shape [*B, count, H, W].

        Raises:
            ConfigError: If the distribution has no classes.
        """
        raise ConfigError(self._no_classes())

    def most_likely(self) -> "TraversabilityDistribution":
        """Return the distribution of λ given each cell's most likely terrain class.

        This is the single-class option of the paper.

        Raises:
            ConfigError: If the distribution has no classes.
        """
        raise ConfigError(self._no_classes())

    def _no_classes(self) -> str:
        return (
            "Expected a distribution with terrain classes for the single-class "
            f"option, got {type(self).__name__}, which has no classes. Use another risk "
            "measure, or a model that predicts classes."
        )

    def _in_float64(self) -> Self:
        """Return the distribution with its floating-point parameters in float64."""

        def convert(values: Tensor) -> Tensor:
            return values.double() if values.is_floating_point() else values

        return map_tensors(self, convert)

    def _with_flat_batch(self) -> Self:
        """Return the distribution with the leading dimensions *B as a single one."""
        n_batch = len(self.shape) - 2

        def flatten(values: Tensor) -> Tensor:
            return values.reshape(-1, *values.shape[n_batch:])

        return map_tensors(self, flatten)

    def _in_chunks(self, compute: Callable[..., Tensor], *layers: Tensor) -> Tensor:
        """Apply a function in chunks of cells, to limit memory.

        Args:
            compute: function of a distribution in float64 and layers, each of shape
                [b, h, w]. It returns values of that shape, computed cell by cell.
            layers: further arguments of `compute`, each of shape [*B, H, W].

        Returns:
            Values of shape [*B, H, W], in the dtype of the parameters.
        """
        with torch.no_grad():
            flat = self._in_float64()._with_flat_batch()
            height, width = self.shape[-2:]
            flat_layers = [layer.reshape(-1, height, width) for layer in layers]
            on_cpu = self.device.type == "cpu"
            chunk_cells = _CHUNK_CELLS_ON_CPU if on_cpu else _CHUNK_CELLS_ON_GPU
            n_maps = max(1, chunk_cells // (height * width))
            n_rows = max(1, chunk_cells // width)
            results = []
            for start in range(0, flat.shape[0], n_maps):
                stop = min(start + n_maps, flat.shape[0])
                indices = torch.arange(start, stop, device=self.device)
                maps = flat.select(indices)
                rows = []
                for top in range(0, height, n_rows):
                    band = slice(top, top + n_rows)
                    chunk = map_tensors(maps, partial(_rows_of, band=band))
                    chunk_layers = [layer[indices, band] for layer in flat_layers]
                    rows.append(compute(chunk, *chunk_layers))
                results.append(torch.cat(rows, dim=1))
            return torch.cat(results).view(self.shape).to(self.dtype)


def _rows_of(values: Tensor, band: slice) -> Tensor:
    return values[..., band, :]


def tail_of(level: float) -> float:
    """Return the probability 1 − α of the tail at a risk level α.

    Raises:
        ConfigError: If the level is outside [0, 1).
    """
    expect(
        0 <= level < 1, f"`level` in [0, 1), got {level}. CVaR at level 0 is the mean."
    )
    return 1 - float(level)


def check_floor(floor: float) -> None:
    """Validate a minimum speed, relative to the commanded speed.

    Raises:
        ConfigError: If the speed is outside (0, 1].
    """
    expect(0 < floor <= 1, f"a minimum speed in (0, 1], got {floor}.")
