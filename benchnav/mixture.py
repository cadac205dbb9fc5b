"""The per-cell probability distribution of traversability, with exact mean, VaR and CVaR.

λ is a Gaussian mixture X clipped to [0, 1]; F is the CDF of X. Risk is the *lower* tail of λ: at
level α both VaR and CVaR speak of the worst share p = 1 − α. Everything here rests on

    G(x) = ∫_{−∞}^x F(t) dt = Σ_k w_k s_k (z Φ(z) + φ(z)),  z = (x − m_k) / s_k,

since for v in [0, 1] the expected shortfall under v is E[(v − λ)⁺] = G(v) − G(0), hence

    E[λ]    = 1 − (G(1) − G(0)),
    VaR_α   = clip(F⁻¹(p), 0, 1),
    CVaR_α  = 1/p ∫₀^p clip(F⁻¹(u), 0, 1) du = v − (G(v) − G(0)) / p  at v = VaR_α.

The last form is flat in v at the VaR (it is a maximum over v), so the error of the root enters
squared. The root is bisected a fixed number of times: no step waits for the worst cell, or for the
device, and the error is bounded whatever the parameters. Arithmetic is in float64 whatever their dtype.

Sources: equation (1) of the paper; Rockafellar and Uryasev (2000), "Optimization of conditional
value-at-risk". Letters in shapes: K components, H×W cells, *B any leading dimensions.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.errors import ConfigError

_SMALLEST_STD = 1e-9
_BISECTIONS = 30  # leave an error of at most 2⁻³¹ < 1e-9


@dataclass(frozen=True)
class TraversabilityMixture:
    """A Gaussian mixture clipped to [0, 1] in each cell of a map.

    Args:
        weights: probability of each component, summing to 1 over K, shape [*B, K, H, W].
        means: component means before clipping, shape [*B, K, H, W].
        stds: component standard deviations before clipping, ≥ 0, shape [*B, K, H, W].

    Raises:
        ConfigError: the shapes differ or have fewer than three dimensions.
    """

    weights: Tensor
    means: Tensor
    stds: Tensor

    def __post_init__(self) -> None:
        """Checks the shapes."""
        if not self.weights.shape == self.means.shape == self.stds.shape or self.weights.ndim < 3:
            raise ConfigError(
                "Expected `weights`, `means` and `stds` of one shape [*B, K, H, W], got "
                f"{list(self.weights.shape)}, {list(self.means.shape)} and {list(self.stds.shape)}."
            )

    def cdf(self, value: Tensor | float) -> Tensor:
        """P(λ ≤ value), with the atoms of clipping at 0 and 1.

        Args:
            value: traversability, a number or shape [*B, H, W].

        Returns:
            Probability, shape [*B, H, W].
        """
        value = torch.as_tensor(value, dtype=torch.float64, device=self.weights.device)
        inside = self._uncensored_cdf(value)
        return torch.where(value < 0, 0.0, torch.where(value >= 1, 1.0, inside)).to(self.weights.dtype)

    def mean(self) -> Tensor:
        """E[λ], shape [*B, H, W]."""
        return self.cvar(0.0)

    def var(self, level: float) -> Tensor:
        """Value at risk: λ falls below it with probability 1 − level.

        Args:
            level: α in [0, 1); at 0 the result is 1, the supremum of λ's range.

        Returns:
            Traversability, shape [*B, H, W].
        """
        return self._value_at_risk(1 - _check_level(level)).to(self.weights.dtype)

    def cvar(self, level: float) -> Tensor:
        """Conditional value at risk: the mean of λ over its worst share 1 − level.

        Args:
            level: α in [0, 1); at 0 the result is the mean.

        Returns:
            Traversability, shape [*B, H, W].
        """
        tail = 1 - _check_level(level)
        value = self._value_at_risk(tail)
        shortfall = self._integrated_cdf(value) - self._integrated_cdf(torch.zeros_like(value))
        return (value - shortfall / tail).clamp(min=0).minimum(value).to(self.weights.dtype)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density on (0, 1); log probability mass at 0 and at 1; −∞ elsewhere.

        Args:
            value: observed traversability, shape [*B, H, W].

        Returns:
            Shape [*B, H, W].
        """
        value = value.to(torch.float64)
        weights, means, stds = self._parameters()
        z = (value.unsqueeze(-3) - means) / stds
        density = -0.5 * z**2 - stds.log() - 0.5 * math.log(2 * math.pi)
        mass_at_0 = torch.special.log_ndtr(-means / stds)
        mass_at_1 = torch.special.log_ndtr((means - 1) / stds)
        at = value.unsqueeze(-3)
        component = torch.where(at <= 0, mass_at_0, torch.where(at >= 1, mass_at_1, density))
        total = torch.logsumexp(component + weights.log(), dim=-3)
        return torch.where((value < 0) | (value > 1), -math.inf, total).to(self.weights.dtype)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Draws λ independently in each cell.

        Args:
            count: draws a cell.
            generator: on the device of the parameters.

        Returns:
            Traversability in [0, 1], shape [count, *B, H, W].
        """
        shape, device = (count, *self.weights.movedim(-3, 0).shape[1:]), self.weights.device
        pick = torch.rand(shape, generator=generator, device=device, dtype=self.weights.dtype)
        edges = self.weights.cumsum(-3)
        component = (pick.unsqueeze(-3) >= edges).sum(-3, keepdim=True).clamp(max=edges.shape[-3] - 1)
        expanded = (count, *self.weights.shape)
        mean = torch.gather(self.means.expand(expanded), -3, component).squeeze(-3)
        std = torch.gather(self.stds.expand(expanded), -3, component).squeeze(-3)
        noise = torch.randn(shape, generator=generator, device=device, dtype=self.weights.dtype)
        return (mean + std * noise).clamp(0, 1)

    def most_likely(self) -> "TraversabilityMixture":
        """Keeps the heaviest component of each cell alone: the paper's single-class option, K = 1."""
        best = self.weights.argmax(dim=-3, keepdim=True)
        means, stds = (torch.gather(t, -3, best) for t in (self.means, self.stds))
        return TraversabilityMixture(torch.ones_like(means), means, stds)

    def _parameters(self) -> tuple[Tensor, Tensor, Tensor]:
        weights, means, stds = (t.to(torch.float64) for t in (self.weights, self.means, self.stds))
        return weights, means, stds.clamp(min=_SMALLEST_STD)

    def _uncensored_cdf(self, value: Tensor) -> Tensor:
        weights, means, stds = self._parameters()
        at = value.unsqueeze(-3) if value.ndim else value
        return (weights * _probability((at - means) / stds)).sum(-3)

    def _integrated_cdf(self, value: Tensor) -> Tensor:
        weights, means, stds = self._parameters()
        z = (value.unsqueeze(-3) - means) / stds
        return (weights * stds * torch.addcmul(_density(z), z, _probability(z))).sum(-3)

    @torch.no_grad()
    def _value_at_risk(self, tail: float) -> Tensor:
        """clip(F⁻¹(tail), 0, 1) in float64, exact at 0 and 1."""
        weights, means, stds = self._parameters()
        low, width = torch.zeros_like(means.select(-3, 0)), 1.0
        if tail >= 1:
            return low + width
        # F(x) = ½ Σ_k w_k erfc(shift_k − x scale_k): few passes over memory, and exact far down in the tail.
        scale = math.sqrt(0.5) / stds
        shift = means * scale

        def twice_cdf(value: Tensor) -> Tensor:
            terms = torch.addcmul(shift, value.unsqueeze(-3), scale, value=-1)
            return terms.erfc_().mul_(weights).sum(-3)

        at_zero, at_one = twice_cdf(low) >= 2 * tail, twice_cdf(low + width) <= 2 * tail
        for _ in range(_BISECTIONS):
            width /= 2
            middle = low + width
            low = torch.where(twice_cdf(middle) < 2 * tail, middle, low)
        return torch.where(at_one, 1.0, torch.where(at_zero, 0.0, low + width / 2))


def _probability(z: Tensor) -> Tensor:
    """Φ(z); several times quicker than `torch.special.ndtr`."""
    return 0.5 * torch.erfc(z * -math.sqrt(0.5))


def _density(z: Tensor) -> Tensor:
    return torch.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)


def _check_level(level: float) -> float:
    if not 0 <= level < 1:
        raise ConfigError(f"Expected `level` in [0, 1), got {level}. CVaR at level 0 is the mean.")
    return float(level)
