"""The per-cell probability distribution of traversability, with exact mean, VaR and
CVaR.

λ is a Gaussian mixture X clipped to [0, 1]; F is the CDF of X. Risk is the *lower* tail
of λ: at level α both VaR and CVaR speak of the worst share 1 − α; `cvar` computes them.
Arithmetic is in float64 whatever the dtype of the parameters, and a cell's numbers do
not depend on how many others there are.

The expected time over the ground, in units of its time at λ = 1, is for a least speed ε

    E[1 / max(λ, ε)] = 1 + ∫_ε^1 F(x) / x² dx
                     = Σ_k w_k (1 + ∫_ε^1 Φ((x − m_k) / s_k) / x² dx),

where each integrand is 0 well below m_k and 1 / x² well above, and is integrated in
between by Gauss-Legendre quadrature over log x.

Sources: equation (1) of the paper; Gneiting and Raftery (2007), "Strictly proper
scoring rules" (CRPS).
Letters in shapes: K components, H×W cells, N cells of a map, *B any leading dimensions.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
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

_SMALLEST_STD = 1e-9
_REACH = 7.0  # standard deviations beyond which Φ is 0 or 1 to within 1e-11

_CRPS_NODES = 48
# from which on these nodes see a component; narrower ones have nodes of their own,
_NARROW_STD = 0.03
_NARROW_NODES = 32  # as many each
_UNDER_1 = 1 - 2**-53  # the largest float64 under 1
_DEEP_TAIL = 1e-6  # under which F has to be exact to its own last bits
_NUMBERS_AT_ONCE = 2**16  # of each parameter: half a MiB in float64
_NUMBERS_ON_A_GPU = 2**24  # where few large pieces are quicker than many small ones


@dataclass(frozen=True)
class TraversabilityMixture(TraversabilityDistribution):
    """A Gaussian mixture clipped to [0, 1] in each cell of a map.

    Args:
        weights: probability of each component, summing to 1 over K up to rounding, by
            which they are divided; shape [*B, K, H, W].
        means: component means before clipping, shape [*B, K, H, W].
        stds: component standard deviations before clipping, ≥ 0, shape [*B, K, H, W].
        group: K numbers: in a cell the components of one number belong to one terrain
            class together; None where components are no classes. Components of −1
            belong to none, as of ground that was not seen.

    Raises:
        ConfigError: the shapes differ or have fewer than three dimensions, or `group`
            has another length.
    """

    weights: Tensor
    means: Tensor
    stds: Tensor
    group: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        """Checks the shapes."""
        if (
            not self.weights.shape == self.means.shape == self.stds.shape
            or self.weights.ndim < 3
        ):
            raise ConfigError(
                "Expected `weights`, `means` and `stds` of one shape [*B, K, H, W], "
                "got "
                f"{list(self.weights.shape)}, {list(self.means.shape)} and "
                f"{list(self.stds.shape)}."
            )
        if self.group is not None and len(self.group) != self.weights.shape[-3]:
            raise ConfigError(
                "Expected `group` to name the class of each of "
                f"{self.weights.shape[-3]} components, "
                f"got {len(self.group)}."
            )

    @property
    def shape(self) -> torch.Size:
        """[*B, H, W]."""
        return self.weights.select(-3, 0).shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """P(λ ≤ value), with the atoms of clipping at 0 and 1.

        Args:
            value: traversability, a number or shape [*B, H, W].

        Returns:
            Probability, shape [*B, H, W].
        """
        value = torch.as_tensor(value, dtype=torch.float64, device=self.weights.device)
        inside = self._uncensored_cdf(value)
        return torch.where(value < 0, 0.0, torch.where(value >= 1, 1.0, inside)).to(
            self.weights.dtype
        )

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """P(λ < value) and P(λ ≤ value), which differ at 0 and 1 alone, each of shape
        [*B, H, W]; see the base.
        """
        value = torch.as_tensor(value, dtype=torch.float64, device=self.weights.device)
        inside = self._uncensored_cdf(value.clamp(max=_UNDER_1)).to(self.weights.dtype)
        lower = torch.where(value <= 0, 0.0, torch.where(value > 1, 1.0, inside))
        return lower, torch.where(value < 0, 0.0, torch.where(value >= 1, 1.0, inside))

    @property
    def searched(self) -> bool:
        """See the base."""
        return bool((self.stds > 0).all())

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Least λ that is not exceeded with this probability, exact at 0 and 1, shape
        [*B, H, W]; see the base.
        """
        share = torch.as_tensor(
            probability, dtype=torch.float64, device=self.weights.device
        )
        share = share.expand(self.shape)
        return torch.where(
            share <= 0, 0.0, self._in_cells(value_at_risk, share, deep=True)
        )

    def mean(self) -> Tensor:
        """E[λ], shape [*B, H, W]."""
        return self._in_cells(mean)

    def var(self, level: float) -> Tensor:
        """Value at risk: λ falls below it with probability 1 − level.

        Args:
            level: α in [0, 1); at 0 the result is 1, the supremum of λ's range.

        Returns:
            Traversability, shape [*B, H, W].
        """
        tail = tail_of(level)
        return (
            torch.ones_like(self.weights.select(-3, 0))
            if tail == 1
            else self._in_tail(value_at_risk, tail)
        )

    def cvar(self, level: float) -> Tensor:
        """Conditional value at risk: the mean of λ over its worst share 1 − level.

        Args:
            level: α in [0, 1); at 0 the result is the mean.

        Returns:
            Traversability, shape [*B, H, W].
        """
        tail = tail_of(level)
        return (
            self.mean() if tail == 1 else self._in_tail(conditional_value_at_risk, tail)
        )

    def chance(self, value: float) -> Tensor:
        """P(λ ≥ value), shape [*B, H, W].

        Args:
            value: traversability in [0, 1].
        """
        if value <= 0:
            return torch.ones_like(self.weights.select(-3, 0))
        below = self._uncensored_cdf(
            torch.tensor(value, dtype=torch.float64, device=self.weights.device)
        )
        return (1 - below).to(self.weights.dtype)

    def expected_time(self, floor: float) -> Tensor:
        """E[1 / max(λ, floor)]: the expected time over the ground, in units of its time
        at λ = 1.

        Args:
            floor: ε in (0, 1], least speed.

        Returns:
            At least 1, shape [*B, H, W], to within 1e-6, or what the dtype can hold.
        """
        check_floor(floor)
        return self._in_cells(lambda cells: _expected_time(cells, floor, 1.0))

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """CVaR of the time 1 / max(λ, floor), shape [*B, H, W], as exact as
        `expected_time`; see the base.
        """
        tail = tail_of(level)
        check_floor(floor)
        if tail == 1:
            return self.expected_time(floor)

        def work(cells: Cells, share: Tensor) -> Tensor:
            least = value_at_risk(cells, share).clamp(floor, 1)
            within = _expected_time(cells, floor, least) - 1 / least
            return 1 / least + within.clamp(min=0) / tail

        return self._in_tail(work, tail)

    def crps(self, observed: Tensor) -> Tensor:
        """Continuous ranked probability score: ∫₀¹ (F(x) − 1[observed ≤ x])² dx.

        As ∫₀¹ F² dx − 2·∫_observed^1 F dx + 1 − observed, to within 1e-5. The second
        integral is of closed form; for the first see `_squared_integral`.

        Args:
            observed: λ in [0, 1], shape [*B, H, W].

        Returns:
            Shape [*B, H, W]; 0 is perfect.
        """
        at = observed.double()
        above = self._integrated_cdf(torch.ones_like(at)) - self._integrated_cdf(at)
        squared = self._squared_integral()
        return (squared - 2 * above + 1 - at).clamp(min=0).to(observed.dtype)

    def from_normal(self, normal: Tensor) -> Tensor:
        """λ of the rank that a standard normal number has: clip(F⁻¹(Φ(z)), 0, 1).

        A field of correlated standard normals gives a field of λ with each cell's own
        distribution (a Gaussian copula).

        Args:
            normal: z, shape [*B, H, W].

        Returns:
            λ in [0, 1], shape [*B, H, W].
        """
        if self.weights.shape[-3] == 1:
            return (self.means.squeeze(-3) + self.stds.squeeze(-3) * normal).clamp(0, 1)
        return self._in_cells(value_at_risk, _probability(normal.double()))

    def to_normal(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """The interval of standard normal numbers that `from_normal` takes to λ, each
        of shape [*B, H, W].

        A single number within (0, 1), and finite there however unlikely λ is; from −∞
        at 0, to ∞ at 1.

        Args:
            value: traversability, a number or shape [*B, H, W].
        """
        value = torch.as_tensor(value, dtype=torch.float64, device=self.weights.device)
        weights, means, stds = self._parameters()
        z = ((value.unsqueeze(-3) if value.ndim else value) - means) / stds
        if z.shape[-3] == 1:
            score = z.squeeze(-3)
        else:  # by the smaller of F and 1 − F, so that neither tail is lost to rounding
            tail, low = _probability(-z.abs()), z < 0
            below, above = (
                (weights * torch.where(side, tail, 1 - tail)).sum(-3)
                for side in (low, ~low)
            )
            least = torch.minimum(below, above).clamp(
                min=torch.finfo(torch.float64).tiny
            )
            score = torch.special.ndtri(least) * torch.where(below <= above, 1.0, -1.0)
        ends = (value <= 0, value > 1), (value < 0, value >= 1)
        lower, upper = (
            torch.where(no, -math.inf, torch.where(all_, math.inf, score))
            for no, all_ in ends
        )
        return lower.to(self.weights.dtype), upper.to(self.weights.dtype)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density on (0, 1); log probability mass at 0 and at 1; −∞ elsewhere.

        Args:
            value: observed traversability, shape [*B, H, W].

        Returns:
            Shape [*B, H, W].
        """
        value = value.to(torch.float64)
        weights, means, stds = self._parameters()
        component = component_log_prob(means, stds, value.unsqueeze(-3))
        total = torch.logsumexp(component + weights.log(), dim=-3)
        # At an end it is a probability, which rounding must not bring above 1.
        total = torch.where((value <= 0) | (value >= 1), total.clamp(max=0), total)
        return torch.where((value < 0) | (value > 1), -math.inf, total).to(
            self.weights.dtype
        )

    def class_probabilities(self, count: int) -> Tensor:
        """Probability of each of `count` terrain classes: the sum of the weights of its
        components.

        Without `group` the components are the classes.

        Returns:
            Shape [*B, count, H, W]; the weights themselves where each class has one
            component, in order.
        """
        if self.group in (None, tuple(range(count))):
            return self.weights
        weights = self.weights.movedim(-3, 0)
        # the last for what belongs to no class
        total = weights.new_zeros(count + 1, *weights.shape[1:])
        places = [count if number < 0 else number for number in self.group]
        total.index_add_(0, torch.tensor(places, device=weights.device), weights)
        return total[:count].movedim(0, -3)

    def most_likely(self) -> "TraversabilityMixture":
        """Keeps the heaviest class of each cell alone, all its components: the paper's
        single-class option.

        Raises:
            ConfigError: the components are not told to belong to classes.
        """
        if self.weights.shape[-3] == 1:
            return TraversabilityMixture(
                torch.ones_like(self.means), self.means, self.stds, (0,)
            )
        if self.group is None:
            raise ConfigError(
                "Expected components that belong to terrain classes for the "
                "single-class option, got a "
                "mixture without `group`. Take another risk measure, or give the "
                "mixture its `group`."
            )
        own = (
            max(self.group) + 1
            # of what belongs to no class, which is all there is where ground was not
            # seen
        )
        group = tuple(own if number < 0 else number for number in self.group)
        best = (
            replace(self, group=group)
            .class_probabilities(own + 1)
            .argmax(-3, keepdim=True)
        )
        is_best = torch.tensor(group, device=best.device).view(-1, 1, 1) == best
        if len(set(group)) == len(group):  # the others need not be kept at no weight
            order = is_best.int().argmax(-3, keepdim=True)
            means, stds = (
                torch.gather(values, -3, order) for values in (self.means, self.stds)
            )
            return TraversabilityMixture(torch.ones_like(means), means, stds, (0,))
        kept = torch.where(is_best, self.weights, 0.0)
        return replace(self, weights=kept / kept.sum(-3, keepdim=True))

    def _in_cells(
        self, work: Callable[..., Tensor], *layers: Tensor, deep: bool = False
    ) -> Tensor:
        """Does some work on so many cells at a time that all stays near the processor.

        Args:
            work: from `Cells` and layers of N cells to numbers [N], each of its own
                cell alone.
            layers: of shape [*B, H, W].
            deep: of the cells.

        Returns:
            Shape [*B, H, W], in the dtype of the parameters.
        """
        parameters = [
            values.movedim(-3, 0).flatten(1)
            for values in (self.weights, self.means, self.stds)
        ]
        numbers = (
            _NUMBERS_AT_ONCE if self.weights.device.type == "cpu" else _NUMBERS_ON_A_GPU
        )
        size = max(1, numbers // len(parameters[0]))
        pieces = (
            values.split(size, -1)
            for values in (*parameters, *(layer.flatten() for layer in layers))
        )
        done = []
        for weights, means, stds, *others in zip(*pieces, strict=True):
            weights, scales = (
                weights.double(),
                math.sqrt(0.5) / stds.double().clamp(min=_SMALLEST_STD),
            )
            done.append(
                work(
                    Cells(weights / added(weights), means.double(), scales, deep),
                    *others,
                )
            )
        return (
            torch.cat(done)
            .view(self.weights.select(-3, 0).shape)
            .to(self.weights.dtype)
        )

    def _in_tail(self, work: Callable[[Cells, Tensor], Tensor], tail: float) -> Tensor:
        """Does some work on the worst share `tail` of λ."""
        return self._in_cells(
            lambda cells: work(cells, torch.full_like(cells.means[0], tail)),
            deep=tail < _DEEP_TAIL,
        )

    def _parameters(self) -> tuple[Tensor, Tensor, Tensor]:
        weights, means, stds = (
            values.double() for values in (self.weights, self.means, self.stds)
        )
        return (
            weights / weights.sum(-3, keepdim=True),
            means,
            stds.clamp(min=_SMALLEST_STD),
        )

    def _squared_integral(self) -> Tensor:
        """∫₀¹ F², float64, shape [*B, H, W].

        Of components that are not narrow, F² is smooth, and Gauss-Legendre quadrature
        in the dtype of the parameters does. A narrow component j adds its products with
        all others k, by parts

            ∫₀¹ Φ_j Φ_k dx = G_k(1) Φ_j(1) − ∫₀¹ G_k φ_j dx,    G_k(x) = ∫₀ˣ Φ_k,

        where G_k of a wider k is smooth over the width of j. Of two narrow ones j is
        the narrower.
        """
        weights, means, stds = (
            values.movedim(-3, 0) for values in (self.weights, self.means, self.stds)
        )
        stds = stds.clamp(min=_SMALLEST_STD)
        narrow = stds < _NARROW_STD
        narrowness, wide = 1 / (stds * math.sqrt(2)), torch.where(narrow, 0, weights)
        squared = torch.zeros_like(weights[0])
        total = wide.sum(0)
        for node, weight in _legendre(_CRPS_NODES):
            weighted = torch.erf_((node - means) * narrowness).mul_(wide)
            squared += weight * (0.5 * (total + weighted.sum(0))) ** 2
        squared = squared.double()
        for index in narrow.flatten(1).any(1).nonzero().flatten().tolist():
            later = (
                torch.arange(len(stds), device=stds.device).view(
                    -1, *[1] * squared.ndim
                )
                > index
            )
            std = stds[index]
            wider = ~narrow | (stds > std) | ((stds == std) & later)
            factor = torch.where(wider, 2 * weights, 0).double()
            factor[index] = weights[index]
            added = _product_integral(means[index], std, means, stds, factor)
            squared += torch.where(narrow[index], weights[index] * added, 0)
        return squared

    def _integrated_cdf(self, value: Tensor) -> Tensor:
        """∫_{−∞}^value F before clipping, float64."""
        weights, means, stds = (
            values.double() for values in (self.weights, self.means, self.stds)
        )
        return (weights * _component_integral(value.unsqueeze(-3), means, stds)).sum(-3)

    def _uncensored_cdf(self, value: Tensor) -> Tensor:
        weights, means, stds = self._parameters()
        at = value.unsqueeze(-3) if value.ndim else value
        return (weights * _probability((at - means) / stds)).sum(-3).clamp(0, 1)


class LogNormalCDF(torch.autograd.Function):
    """log Φ(z) with the gradient φ/Φ as √(2/π) / erfcx(−z/√2).

    That of `torch.special.log_ndtr` takes the difference of two squares: in float32 it
    is 5 % off at z = −10³ and of no use from −10⁴ on, and a component of small width
    that lies far off gets there.
    """

    @staticmethod
    def forward(context: Any, z: Tensor) -> Tensor:
        """log Φ(z), shape of `z`."""
        context.save_for_backward(z)
        return torch.special.log_ndtr(z)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        """Gradient by z."""
        (z,) = context.saved_tensors
        return (
            gradients[0]
            * math.sqrt(2 / math.pi)
            / torch.special.erfcx(-z / math.sqrt(2))
        )


def component_log_prob(means: Tensor, stds: Tensor, value: Tensor) -> Tensor:
    """Log density of each component inside (0, 1), and log of its mass that is clipped
    at 0 and at 1.

    Args:
        means: before clipping, shape [*B, K, H, W].
        stds: before clipping, > 0, shape [*B, K, H, W].
        value: λ, shape [*B, 1, H, W].

    Returns:
        Shape [*B, K, H, W].
    """
    z = (value - means) / stds
    density = -0.5 * z**2 - stds.log() - 0.5 * math.log(2 * math.pi)
    mass = LogNormalCDF.apply(torch.where(value <= 0, -means, means - 1) / stds)
    return torch.where((value <= 0) | (value >= 1), mass, density)


def _expected_time(cells: Cells, floor: float, most: Tensor | float) -> Tensor:
    """1 / most + ∫ F / x² from the floor to the most λ, of N cells, to within 1e-8."""
    nodes = 28 + 8 * math.ceil(math.log(max(0.05 / floor, 1), 5))
    # Beyond [low, high] the CDF of a component is 0 or 1, and the integral of 1 / x² is
    # known.
    reach = _REACH * math.sqrt(0.5) / cells.scales
    low, high = (
        (cells.means + way).clamp(min=floor).clamp(max=most) for way in (-reach, reach)
    )
    start, span = low.log(), high.log() - low.log()
    time = 1 / most + (1 / high - 1 / most)
    for node, weight in _legendre(nodes):
        value = (start + span * node).exp_()
        below = torch.erf((value - cells.means).mul_(cells.scales)).add_(1)
        time.addcmul_(span * (0.5 * weight), below.div_(value))
    return added(cells.weights * time).clamp(min=1)


def _component_integral(value: Tensor, means: Tensor, stds: Tensor) -> Tensor:
    """∫_{−∞}^value of the CDF of normal components, float64, of shapes that broadcast."""
    stds = stds.double().clamp(min=_SMALLEST_STD)
    z = (value.double() - means.double()) / stds
    density = torch.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
    return stds * (z * torch.special.ndtr(z) + density)


def _product_integral(
    mean: Tensor, std: Tensor, means: Tensor, stds: Tensor, factor: Tensor
) -> Tensor:
    """Σ_k factor_k ∫₀¹ Φ Φ_k dx of a component and K others that are no narrower; see
    `_squared_integral`.

    Args:
        mean: of the component, shape [*B, H, W].
        std: shape [*B, H, W].
        means: of the others, shape [K, *B, H, W].
        stds: shape [K, *B, H, W].
        factor: shape [K, *B, H, W].

    Returns:
        float64, shape [*B, H, W].
    """
    mean, std = mean.double(), std.double()
    below = _component_integral(torch.zeros_like(mean), means, stds)

    def integral(value: Tensor) -> Tensor:
        return (factor * (_component_integral(value, means, stds) - below)).sum(0)

    low, high = ((end - mean) / std for end in (0.0, 1.0))
    total = integral(torch.ones_like(mean)) * _probability(high)
    low, high = low.clamp(-_REACH, _REACH), high.clamp(-_REACH, _REACH)
    for node, weight in _legendre(_NARROW_NODES):
        z = low + (high - low) * node
        density = torch.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
        total = total - weight * (high - low) * density * integral(mean + std * z)
    return total


@functools.cache
def _legendre(count: int) -> list[tuple[float, float]]:
    """Nodes and weights of Gauss-Legendre quadrature on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return list(
        zip((0.5 + 0.5 * nodes).tolist(), (0.5 * weights).tolist(), strict=True)
    )


def _probability(z: Tensor) -> Tensor:
    """Φ(z); several times quicker than `torch.special.ndtr`."""
    return 0.5 * torch.erfc(z * -math.sqrt(0.5))
