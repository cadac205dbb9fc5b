"""Clipped Gaussian mixtures of traversability, with exact mean, VaR and CVaR.

λ is a Gaussian mixture X clipped to [0, 1]; F is the CDF of X. Risk is the *lower* tail
of λ: at level α, VaR and CVaR refer to the worst 1 − α fraction (`benchnav.core.cvar`).
Computations are in float64 for any dtype of the parameters, and a cell's results do not
depend on the number of cells.

With a minimum speed ε, the expected time over terrain, relative to the time at λ = 1,
is

    E[1 / max(λ, ε)] = 1 + ∫_ε^1 F(x) / x² dx
                     = Σ_k w_k (1 + ∫_ε^1 Φ((x − m_k) / s_k) / x² dx),

where the integrand of component k is 0 well below m_k and 1 / x² well above it. In
between, it is integrated by Gauss-Legendre quadrature over log x.

Sources: equation (1) of the paper; Gneiting and Raftery (2007), "Strictly proper
scoring rules" (CRPS).
Letters in shapes: K components; H×W cells; N cells; *B any leading dimensions.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.cvar import (
    Cells,
    added,
    conditional_value_at_risk,
    mean,
    value_at_risk,
)
from benchnav.core.distribution import TraversabilityDistribution, check_floor, tail_of
from benchnav.core.errors import ConfigError
from benchnav.core.mixture_density import component_log_prob
from benchnav.core.mixture_integrals import (
    MIN_STD,
    component_integral,
    expected_time,
    normal_cdf,
    squared_integral,
)

_BELOW_1 = 1 - 2**-53  # the largest float64 below 1
_DEEP_TAIL = 1e-6  # for smaller tails, the relative error of F must be small
# Numbers of each parameter in a chunk: half a MiB in float64.
_CHUNK_NUMBERS_ON_CPU = 2**16
# Larger, since few large chunks are faster than many small chunks on a GPU.
_CHUNK_NUMBERS_ON_GPU = 2**24


@dataclass(frozen=True)
class TraversabilityMixture(TraversabilityDistribution):
    """A Gaussian mixture clipped to [0, 1] in each cell of a map.

    Args:
        weights: probability of each component, summing to 1 over K up to rounding (they
            are normalised in computations), shape [*B, K, H, W].
        means: component means before clipping, shape [*B, K, H, W].
        stds: component standard deviations before clipping, ≥ 0, shape [*B, K, H, W].
        group: index of the terrain class of each of the K components; −1 for components
            without a class, as in unobserved cells. If None, no component has a class.

    Raises:
        ConfigError: If the shapes differ or have fewer than three dimensions, or
            `group` has another length.
    """

    weights: Tensor
    means: Tensor
    stds: Tensor
    group: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        """Validate the shapes."""
        weights = self.weights.shape
        means = self.means.shape
        stds = self.stds.shape
        is_same = weights == means == stds
        if not is_same or len(weights) < 3:
            raise ConfigError(
                "Expected `weights`, `means` and `stds` of the same shape [*B, K, H, W], "
                f"got {list(weights)}, {list(means)} and {list(stds)}."
            )
        n_components = weights[-3]
        if self.group is not None and len(self.group) != n_components:
            raise ConfigError(
                f"Expected `group` with one class index for each of {n_components} "
                f"components, got {len(self.group)} indices."
            )

    @property
    def shape(self) -> torch.Size:
        """Shape of the maps, [*B, H, W]."""
        return self.weights.select(-3, 0).shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """Return P(λ ≤ value), which includes the atoms at 0 and 1 due to clipping.

        Args:
            value: traversability, a number or shape [*B, H, W].

        Returns:
            Probability, shape [*B, H, W].
        """
        value = self._as_tensor(value)
        inside = self._unclipped_cdf(value)
        upper = torch.where(value >= 1, 1.0, inside)
        return torch.where(value < 0, 0.0, upper).to(self.dtype)

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return P(λ < value) and P(λ ≤ value), each of shape [*B, H, W].

        The two probabilities differ only at 0 and 1.
        """
        value = self._as_tensor(value)
        at = value.clamp(max=_BELOW_1)
        inside = self._unclipped_cdf(at).to(self.dtype)
        lower = torch.where(value > 1, 1.0, inside)
        lower = torch.where(value <= 0, 0.0, lower)
        upper = torch.where(value >= 1, 1.0, inside)
        upper = torch.where(value < 0, 0.0, upper)
        return lower, upper

    @property
    def searched(self) -> bool:
        """Whether `quantile` is a search, and λ has no atoms in (0, 1)."""
        return bool((self.stds > 0).all())

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Return the quantiles of λ, shape [*B, H, W]; quantiles 0 and 1 are exact."""
        u = self._as_tensor(probability).expand(self.shape)
        quantiles = self._in_cells(value_at_risk, u, deep=True)
        return torch.where(u <= 0, 0.0, quantiles)

    def mean(self) -> Tensor:
        """Return E[λ], shape [*B, H, W]."""
        return self._in_cells(mean)

    def var(self, level: float) -> Tensor:
        """Return the value at risk: λ is below it with probability 1 − level.

        Args:
            level: α in [0, 1); at 0 the result is 1, the upper end of λ's range.

        Returns:
            Traversability, shape [*B, H, W].
        """
        tail = tail_of(level)
        if tail == 1:
            return torch.ones_like(self.weights.select(-3, 0))
        return self._in_tail(value_at_risk, tail)

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
        return self._in_tail(conditional_value_at_risk, tail)

    def chance(self, value: float) -> Tensor:
        """Return the exceedance probability P(λ ≥ value), shape [*B, H, W].

        Args:
            value: traversability in [0, 1].
        """
        if value <= 0:
            return torch.ones_like(self.weights.select(-3, 0))
        below = self._unclipped_cdf(self._as_tensor(value))
        return (1 - below).to(self.dtype)

    def expected_time(self, floor: float) -> Tensor:
        """Return E[1 / max(λ, floor)], the expected time relative to time at λ = 1.

        Args:
            floor: minimum speed ε, in (0, 1].

        Returns:
            Values ≥ 1, shape [*B, H, W]. Their error is at most 1e-6 or the precision
            of the dtype.
        """
        check_floor(floor)
        return self._in_cells(lambda cells: expected_time(cells, floor, 1.0))

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """Return the CVaR of the time 1 / max(λ, floor), shape [*B, H, W].

        Its error is at most that of `expected_time`.
        """
        tail = tail_of(level)
        check_floor(floor)
        if tail == 1:
            return self.expected_time(floor)

        def compute(cells: Cells, probability: Tensor) -> Tensor:
            value = value_at_risk(cells, probability).clamp(floor, 1)
            excess = expected_time(cells, floor, value) - 1 / value
            return 1 / value + excess.clamp(min=0) / tail

        return self._in_tail(compute, tail)

    def crps(self, observed: Tensor) -> Tensor:
        """Return the continuous ranked probability score ∫₀¹ (F(x) − 1[y ≤ x])² dx.

        It is computed as ∫₀¹ F² dx − 2·∫_y^1 F dx + 1 − y, with an error of at most
        1e-5. `squared_integral` is the first integral; the second has a closed form.

        Args:
            observed: observed λ y in [0, 1], shape [*B, H, W].

        Returns:
            Scores of shape [*B, H, W]; 0 is perfect.
        """
        at = observed.double()
        up_to_1 = self._integrated_cdf(torch.ones_like(at))
        above = up_to_1 - self._integrated_cdf(at)
        parameters = (self.weights, self.means, self.stds)
        squared = squared_integral(*(values.movedim(-3, 0) for values in parameters))
        score = squared - 2 * above + 1 - at
        return score.clamp(min=0).to(observed.dtype)

    def from_normal(self, normal: Tensor) -> Tensor:
        """Return λ of standard normal scores, clip(F⁻¹(Φ(z)), 0, 1).

        A field of correlated standard normals becomes a λ field whose marginals are the
        distributions of the cells (a Gaussian copula).

        Args:
            normal: z, shape [*B, H, W].

        Returns:
            λ in [0, 1], shape [*B, H, W].
        """
        if self.weights.shape[-3] == 1:
            mean = self.means.squeeze(-3)
            std = self.stds.squeeze(-3)
            unclipped = mean + std * normal
            return unclipped.clamp(0, 1)
        return self._in_cells(value_at_risk, normal_cdf(normal.double()))

    def to_normal(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return the interval of standard normal scores that `from_normal` maps to λ.

        For λ in (0, 1), both ends are equal and finite, however improbable λ is. For
        λ = 0 the lower end is −∞, and for λ = 1 the upper end is ∞.

        Args:
            value: traversability λ, a number or shape [*B, H, W].

        Returns:
            Both ends, each of shape [*B, H, W].
        """
        value = self._as_tensor(value)
        weights, means, stds = self._parameters()
        z = (_with_components(value) - means) / stds
        if z.shape[-3] == 1:
            score = z.squeeze(-3)
        else:
            # The smaller of F and 1 − F has no rounding errors in either tail.
            tail = normal_cdf(-z.abs())
            is_low = z < 0
            component_below = torch.where(is_low, tail, 1 - tail)
            component_above = torch.where(~is_low, tail, 1 - tail)
            below = (weights * component_below).sum(-3)
            above = (weights * component_above).sum(-3)
            tiny = torch.finfo(torch.float64).tiny
            smaller = torch.minimum(below, above).clamp(min=tiny)
            sign = torch.where(below <= above, 1.0, -1.0)
            score = torch.special.ndtri(smaller) * sign
        lower = torch.where(value > 1, math.inf, score)
        lower = torch.where(value <= 0, -math.inf, lower)
        upper = torch.where(value >= 1, math.inf, score)
        upper = torch.where(value < 0, -math.inf, upper)
        return lower.to(self.dtype), upper.to(self.dtype)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log density on (0, 1), log mass at 0 and at 1, and −∞ elsewhere.

        Args:
            value: observed traversability, shape [*B, H, W].

        Returns:
            Values of shape [*B, H, W].
        """
        value = value.to(torch.float64)
        weights, means, stds = self._parameters()
        component = component_log_prob(means, stds, value.unsqueeze(-3))
        total = torch.logsumexp(component + weights.log(), dim=-3)
        # At 0 and 1, the total is a log probability, which rounding must not make > 0.
        is_end = (value <= 0) | (value >= 1)
        total = torch.where(is_end, total.clamp(max=0), total)
        is_outside = (value < 0) | (value > 1)
        return torch.where(is_outside, -math.inf, total).to(self.dtype)

    def class_probabilities(self, count: int) -> Tensor:
        """Return the probability of each of `count` terrain classes.

        The probability of a class is the sum of the weights of its components. If
        `group` is None, each component is a class.

        Returns:
            Probabilities of shape [*B, count, H, W]; the weights themselves if each
            class has one component, in order.
        """
        if self.group in (None, tuple(range(count))):
            return self.weights
        weights = self.weights.movedim(-3, 0)
        # Weights of components without a class are added at the last index.
        total = weights.new_zeros(count + 1, *weights.shape[1:])
        indices = [count if index < 0 else index for index in self.group]
        class_index = torch.tensor(indices, device=weights.device)
        total.index_add_(0, class_index, weights)
        return total[:count].movedim(0, -3)

    def most_likely(self) -> "TraversabilityMixture":
        """Return the mixture given each cell's most likely terrain class.

        It contains all components of that class. This is the single-class option of
        the paper.

        Raises:
            ConfigError: If the components have no classes.
        """
        if self.weights.shape[-3] == 1:
            return _single_component(self.means, self.stds)
        if self.group is None:
            raise ConfigError(
                "Expected components that belong to terrain classes for the "
                "single-class option, got a mixture without `group`. Use another risk "
                "measure, or set `group`."
            )
        # Components without a class form one further class, since unobserved cells
        # have only such components.
        no_class = max(self.group) + 1
        group = tuple(no_class if index < 0 else index for index in self.group)
        grouped = replace(self, group=group)
        best = grouped.class_probabilities(no_class + 1).argmax(-3, keepdim=True)
        component_class = torch.tensor(group, device=best.device)
        is_best = component_class.view(-1, 1, 1) == best
        if len(set(group)) == len(group):  # each class has a single component
            index = is_best.int().argmax(-3, keepdim=True)
            means = torch.gather(self.means, -3, index)
            stds = torch.gather(self.stds, -3, index)
            return _single_component(means, stds)
        weights = torch.where(is_best, self.weights, 0.0)
        return replace(self, weights=weights / weights.sum(-3, keepdim=True))

    def _in_cells(
        self, compute: Callable[..., Tensor], *layers: Tensor, deep: bool = False
    ) -> Tensor:
        """Apply a function in chunks of cells that fit in the processor's cache.

        Args:
            compute: function of `Cells` and layers of N cells. It returns values of
                shape [N]. The value of a cell depends only on that cell.
            layers: further arguments of `compute`, each of shape [*B, H, W].
            deep: `Cells.deep`: whether the relative error of F must be small.

        Returns:
            Values of shape [*B, H, W], in the dtype of the parameters.
        """
        all_parameters = (self.weights, self.means, self.stds)
        parameters = [values.movedim(-3, 0).flatten(1) for values in all_parameters]
        is_cpu = self.weights.device.type == "cpu"
        numbers = _CHUNK_NUMBERS_ON_CPU if is_cpu else _CHUNK_NUMBERS_ON_GPU
        size = max(1, numbers // len(parameters[0]))
        flat = [*parameters, *(layer.flatten() for layer in layers)]
        chunks = [values.split(size, -1) for values in flat]
        results = []
        for weights, means, stds, *others in zip(*chunks, strict=True):
            weights = weights.double()
            normalised = weights / added(weights)
            scales = math.sqrt(0.5) / stds.double().clamp(min=MIN_STD)
            cells = Cells(normalised, means.double(), scales, deep)
            results.append(compute(cells, *others))
        return torch.cat(results).view(self.shape).to(self.dtype)

    def _in_tail(
        self, compute: Callable[[Cells, Tensor], Tensor], tail: float
    ) -> Tensor:
        """Apply a function of cells and of the tail's probability."""

        def compute_tail(cells: Cells) -> Tensor:
            probability = torch.full_like(cells.means[0], tail)
            return compute(cells, probability)

        return self._in_cells(compute_tail, deep=tail < _DEEP_TAIL)

    def _as_tensor(self, value: Tensor | float) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64, device=self.device)

    def _parameters(self) -> tuple[Tensor, Tensor, Tensor]:
        weights = self.weights.double()
        normalised = weights / weights.sum(-3, keepdim=True)
        stds = self.stds.double().clamp(min=MIN_STD)
        return normalised, self.means.double(), stds

    def _integrated_cdf(self, value: Tensor) -> Tensor:
        """Return ∫_{−∞}^value F before clipping, float64, shape [*B, H, W]."""
        value = value.unsqueeze(-3)
        integrals = component_integral(value, self.means, self.stds)
        return (self.weights.double() * integrals).sum(-3)

    def _unclipped_cdf(self, value: Tensor) -> Tensor:
        weights, means, stds = self._parameters()
        z = (_with_components(value) - means) / stds
        probability = (weights * normal_cdf(z)).sum(-3)
        return probability.clamp(0, 1)


def _with_components(value: Tensor) -> Tensor:
    """Return a value with a dimension for the components, or a number unchanged."""
    return value.unsqueeze(-3) if value.ndim else value


def _single_component(means: Tensor, stds: Tensor) -> TraversabilityMixture:
    return TraversabilityMixture(torch.ones_like(means), means, stds, (0,))
