"""VaR and CVaR of Gaussian mixtures clipped to [0, 1], cell by cell.

λ is a Gaussian mixture X clipped to [0, 1]; F is the CDF of X. Risk is the *lower* tail
of λ: at level α, VaR and CVaR refer to the worst fraction p = 1 − α, called the tail.
With

    G(x) = ∫_{−∞}^x F(t) dt = Σ_k w_k s_k (z Φ(z) + φ(z)),  z = (x − m_k) / s_k,

the expected shortfall below v in [0, 1] is E[(v − λ)⁺] = G(v) − G(0). Hence

    E[λ]    = 1 − (G(1) − G(0)),
    VaR_α   = clip(F⁻¹(p), 0, 1),
    CVaR_α  = 1/p ∫₀^p clip(F⁻¹(u), 0, 1) du = v − (G(v) − G(0)) / p  at v = VaR_α.

The last form, as a function of v, has its maximum at the VaR. If v has an error d, the
form is too low by at most |F(v) / p − 1| d. A root v of F(v) = p in float32 therefore
suffices, and the form is evaluated at v in float64. The search for the root continues
in float64 if that bound is too large, or if d is unreliable because the density changes
between v and the root.

The root is found by Newton's method on the log odds of F, which are closer to linear
than F, between a lower and an upper bound. If a step leaves the bounds, their interval
is bisected instead. The interval is also bisected if the last step in float32 would be
long, and at every other step after the first few in float64, so that all cells
converge. On a CPU, converged cells leave the search. On other devices, all cells take
all steps, because to wait for the device takes longer.

Sources: equation (1) of the paper; Rockafellar and Uryasev (2000), "Optimization of
conditional value-at-risk".
Letters in shapes: K components; N cells.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

_FLOAT32_STEPS = 4  # number of steps of the search in float32
_MAX_FLOAT64_STEPS = 80
_FREE_STEPS = 6  # number of steps in float64 after which every other step bisects
_VAR_ERROR, _CVAR_ERROR = 1e-10, 1e-9  # tolerances of VaR and CVaR
_CDF_ERROR = 1e-9  # tolerance of F relative to the tail
# Number of standard deviations within which the density changes little.
_LINEAR_STDS = 0.1
_MIN_GAP = 1e-11  # the search ends if the bounds are closer
# Limit of |√½ z|; beyond it, densities are subnormal numbers.
_MAX_SCALED_Z = {torch.float32: 9.0, torch.float64: 26.0}
_MAX_LOG_ODDS = 16.0  # beyond ±16, probabilities in float32 are 0 or 1
_LOGISTIC_STD = math.sqrt(3) / math.pi  # standard deviations per unit of log odds


@dataclass(frozen=True)
class Cells:
    """Mixtures of N cells before clipping.

    Args:
        weights: weights of the components, summing to 1 over K, shape [K, N].
        means: means of the components, shape [K, N].
        scales: √½ divided by the components' standard deviations, shape [K, N].
        deep: whether the error of F is small relative to F, as required for tails below
            10⁻⁶. Otherwise it is small relative to 1, which takes half the time.
    """

    weights: Tensor
    means: Tensor
    scales: Tensor
    deep: bool = False

    def below(self, z: Tensor) -> Tensor:
        """Return 2 Φ(√2 z) if `deep`, else 2 Φ(√2 z) − 1, shape of `z`."""
        return torch.erfc(-z) if self.deep else torch.erf(z)

    def cdf_of(self, total: Tensor) -> Tensor:
        """Return F from the sum of `below` over components, weighted; shape [N]."""
        return total / 2 if self.deep else (total + 1) / 2

    def integral(self, value: Tensor | float) -> Tensor:
        """Return G(value), shape [N]."""
        return self._sum_of_integrals(*self._terms(value))

    def around(self, value: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return F, its density, a local standard deviation and G, each of shape [N].

        The local standard deviation is the mean of the components' standard deviations,
        weighted by their densities at the value.
        """
        z, below, density = self._terms(value)
        total = added(self.weights * below)
        slope = added(self.weights * (density * self.scales))
        mass = added(self.weights * density)
        std = math.sqrt(0.5) * mass / slope
        return (
            self.cdf_of(total),
            slope,
            std,
            self._sum_of_integrals(z, below, density),
        )

    def _terms(self, value: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
        """Return z, `below(z)` and exp(−z²) / √π of each component, shape [K, N]."""
        z = (value - self.means) * self.scales
        return z, self.below(z), (-z * z).exp() / math.sqrt(math.pi)

    def _sum_of_integrals(self, z: Tensor, below: Tensor, density: Tensor) -> Tensor:
        """Return G, the sum of w (z (1 + below) + density) / (2 scale), shape [N]."""
        twice_cdf = below if self.deep else below + 1
        terms = torch.addcmul(density, z, twice_cdf) / (2 * self.scales)
        return added(self.weights * terms)

    def select(self, indices: Tensor) -> "Cells":
        """Return selected cells, by index."""
        weights = self.weights.index_select(1, indices)
        means = self.means.index_select(1, indices)
        scales = self.scales.index_select(1, indices)
        return Cells(weights, means, scales, self.deep)

    def float(self) -> "Cells":
        """Return the cells in float32, with `deep` false."""
        return Cells(self.weights.float(), self.means.float(), self.scales.float())


def mean(cells: Cells) -> Tensor:
    """Return E[λ], differentiable in the parameters, shape [N]."""
    expectation = 1 - (cells.integral(1.0) - cells.integral(0.0))
    return expectation.clamp(0, 1)  # rounding errors are up to 1e-16


@torch.no_grad()
def value_at_risk(cells: Cells, tail: Tensor) -> Tensor:
    """Return clip(F⁻¹(tail), 0, 1), shape [N]; values 0 and 1 are exact.

    Args:
        cells: mixtures in float64.
        tail: probability p in (0, 1), shape [N].
    """
    root = _root(cells, tail, _first_root(cells, tail), is_var=True)
    return torch.where(cells.means.isnan().any(0), torch.nan, root)


def conditional_value_at_risk(cells: Cells, tail: Tensor) -> Tensor:
    """Return E[λ] over its lower tail, differentiable in the parameters, shape [N].

    Args:
        cells: mixtures in float64.
        tail: probability p in (0, 1), shape [N].
    """
    value = _first_root(cells, tail)
    cdf, density, std, integral = cells.around(value)
    with torch.no_grad():
        excess = cdf - tail
        error = excess / density
        is_exact = (excess * error).abs() < _CVAR_ERROR * tail
        is_linear = error.abs() < _LINEAR_STDS * std
        is_inexact = ~((is_exact & is_linear) | _at_an_end(value, excess))
        value = _replaced(value, is_inexact, _root, cells, tail, value)
    integral = _replaced(integral, is_inexact, Cells.integral, cells, value)
    cvar = value - (integral - cells.integral(0.0)) / tail
    return cvar.clamp(min=0).minimum(value)


def _may_wait(values: Tensor) -> bool:
    """Return whether a value can be read without waiting for a device."""
    return values.device.type == "cpu"


def _at_an_end(value: Tensor, excess: Tensor) -> Tensor:
    """Return a mask of cells whose value is an end of [0, 1] and whose root is outside."""
    return ((value == 0) & (excess >= 0)) | ((value == 1) & (excess <= 0))


def _replaced(
    values: Tensor,
    mask: Tensor,
    compute: Callable[..., Tensor],
    cells: Cells,
    *columns: Tensor,
) -> Tensor:
    """Return values, shape [N], after computing those of masked cells again."""
    if not _may_wait(values):
        return torch.where(mask, compute(cells, *columns), values)
    indices = mask.nonzero().squeeze(1)
    if len(indices) == 0:
        return values
    selected = [column[indices] for column in columns]
    return values.index_copy(0, indices, compute(cells.select(indices), *selected))


@torch.no_grad()
def _first_root(cells: Cells, tail: Tensor) -> Tensor:
    """Search x in [0, 1] with F(x) = tail by a few steps in float32."""
    short = cells.float()
    p = tail.float()
    mean = added(short.weights * short.means)
    squares = short.means.square() + 0.5 / short.scales.square()
    variance = added(short.weights * squares) - mean.square()
    odds = torch.logit(tail).clamp(-_MAX_LOG_ODDS, _MAX_LOG_ODDS).float()
    value = (mean + _LOGISTIC_STD * variance.clamp(min=0).sqrt() * odds).clamp(0, 1)
    low = torch.zeros_like(value)
    high = torch.ones_like(value)
    slopes = short.weights * short.scales
    for count in range(_FLOAT32_STEPS):
        is_last = count == _FLOAT32_STEPS - 1
        _, _, value, low, high = _step(
            short, slopes, p, odds, value, low, high, bisect=is_last
        )
    return value.to(tail)


def _root(cells: Cells, tail: Tensor, value: Tensor, is_var: bool = False) -> Tensor:
    """Search x in [0, 1] with F(x) = tail in float64, shape [N].

    Args:
        cells: mixtures of N cells.
        tail: probability, shape [N].
        value: initial values of x, shape [N].
        is_var: whether x must converge, in addition to F(x).
    """
    roots = value.clone()
    active = torch.arange(len(value), device=value.device)
    converged = torch.zeros_like(value, dtype=torch.bool)
    low = torch.zeros_like(value)
    high = torch.ones_like(value)
    odds = torch.logit(tail)
    for count in range(_MAX_FLOAT64_STEPS):
        bisect = count >= _FREE_STEPS and count % 2 == 1
        slopes = cells.weights * cells.scales
        excess, error, next_value, low, high = _step(
            cells, slopes, tail, odds, value, low, high, bisect
        )
        ended = excess.abs() < _CDF_ERROR * tail
        if is_var:
            ended &= error.abs() < _VAR_ERROR
        ended |= _at_an_end(value, excess)
        ended |= high - low < _MIN_GAP
        ended |= excess.isnan()  # cells with NaN parameters have no root
        value = torch.where(ended, value, next_value)
        if not _may_wait(value):
            roots = torch.where(converged, roots, value)
            converged = converged | ended
            continue
        roots[active] = value
        remaining = (~ended).nonzero().squeeze(1)
        if len(remaining) == 0:
            break
        cells = cells.select(remaining)
        active = active[remaining]
        columns = (tail, odds, value, low, high)
        tail, odds, value, low, high = (column[remaining] for column in columns)
    return roots


def _step(
    cells: Cells,
    slopes: Tensor,
    tail: Tensor,
    odds: Tensor,
    value: Tensor,
    low: Tensor,
    high: Tensor,
    bisect: bool,
) -> tuple[Tensor, ...]:
    """Take one step of Newton's method on the log odds of F, or bisect the interval.

    Args:
        cells: mixtures of N cells.
        slopes: weights times scales of the components, shape [K, N].
        tail: probability p, shape [N].
        odds: log odds of p, shape [N].
        value: present values of x, shape [N].
        low: lower bounds of the root, shape [N].
        high: upper bounds of the root, shape [N].
        bisect: whether to bisect instead of a long Newton step in float32, or of any
            Newton step in float64.

    Returns:
        F(x) − p, the error of x as estimated from the density, the new x, and the new
        lower and upper bounds; each of shape [N].
    """
    z = (value - cells.means).mul_(cells.scales)
    cdf = cells.cdf_of(added(cells.below(z).mul_(cells.weights)))
    limit = _MAX_SCALED_Z[z.dtype]
    terms = z.clamp_(-limit, limit).square_().neg_().exp_().mul_(slopes)
    density = added(terms).div_(math.sqrt(math.pi))
    excess = cdf - tail
    is_below = excess < 0
    low = torch.where(is_below, value, low)
    high = torch.where(is_below, high, value)
    # The step is NaN where F is 0 or 1; the interval is then bisected.
    step = (odds - torch.logit(cdf)) * (cdf * (1 - cdf) / density)
    newton_value = (value + step).clamp(0, 1)
    is_inside = (newton_value >= low) & (newton_value <= high)
    if bisect:
        is_inside &= (step.abs() < 0.1 * (high - low)) & (z.dtype == torch.float32)
    next_value = torch.where(is_inside, newton_value, (low + high) / 2)
    return excess, excess / density, next_value, low, high


def added(terms: Tensor) -> Tensor:
    """Return the sum over K, [K, N] to [N], in an order that does not depend on N.

    The order of `torch.sum` depends on N, and so does its rounding.
    """
    total = terms[0].clone()
    for term in terms[1:]:
        total += term
    return total
