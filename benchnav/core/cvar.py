"""VaR and CVaR of Gaussian mixtures clipped to [0, 1], cell by cell.

λ is a Gaussian mixture X clipped to [0, 1]; F is the CDF of X. Risk is the *lower* tail
of λ: at level α both VaR and CVaR speak of the worst share p = 1 − α, the tail. All
rests on

    G(x) = ∫_{−∞}^x F(t) dt = Σ_k w_k s_k (z Φ(z) + φ(z)),  z = (x − m_k) / s_k,

since for v in [0, 1] the expected shortfall under v is E[(v − λ)⁺] = G(v) − G(0), hence

    E[λ]    = 1 − (G(1) − G(0)),
    VaR_α   = clip(F⁻¹(p), 0, 1),
    CVaR_α  = 1/p ∫₀^p clip(F⁻¹(u), 0, 1) du = v − (G(v) − G(0)) / p  at v = VaR_α.

The last form is a maximum over v, so it is flat at the VaR: at a v that is off by d it
is too low by at most
|F(v) / p − 1| d. So a root in float32 will do, at which float64 is evaluated once. Where that bound is not small
enough, or d cannot be told since the density changes on the way, the search goes on in
float64.

The root is sought by Newton's method on the log odds of F, which are straighter than F,
between bounds that close in. Where a step leaves the bounds they are halved; in float32
also at the last step, where it is still long, and in float64 at every other step after
the first few, so that every cell gets there. On the CPU a cell that has its root leaves
the search, so that none waits for the worst; on other devices all cells take all steps,
so that nothing waits for the device.

Sources: equation (1) of the paper; Rockafellar and Uryasev (2000), "Optimization of
conditional value-at-risk".
Letters in shapes: K components, N cells.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

_SHORT_SEARCH, _LONG_SEARCH = 4, 80  # steps in float32, and most in float64
_FREE_STEPS = 6  # of Newton's method, after which every other step halves the bounds
_VAR_ERROR, _CVAR_ERROR = 1e-10, 1e-9  # at which a search ends
_SHARE_ERROR = 1e-9  # of F, as a share of the tail
_STRAIGHT = 0.1  # standard deviations within which a density hardly changes
_LEAST_GAP = 1e-11  # between bounds
# of √½ z, beyond which densities are too small to be normal numbers
_REACH = {
    torch.float32: 9.0,
    torch.float64: 26.0,
}
_MOST_ODDS = 16.0  # logarithms; beyond them float32 holds no share but 0 and 1
_LOGISTIC_STD = math.sqrt(3) / math.pi  # standard deviations a unit of log odds


@dataclass(frozen=True)
class Cells:
    """Mixtures before clipping, z = (x − means) scales / √½ being their standard normal
    numbers.

    Args:
        weights: summing to 1 over K, shape [K, N].
        means: shape [K, N].
        scales: √½ over the standard deviations, shape [K, N].
        deep: whether F is to be exact to the last bits of itself, as a tail under a
            millionth needs, rather than to those of 1, which takes half the time.
    """

    weights: Tensor
    means: Tensor
    scales: Tensor
    deep: bool = False

    def below(self, z: Tensor) -> Tensor:
        """2 Φ of z / √½, less 1 unless `deep`."""
        return torch.erfc(-z) if self.deep else torch.erf(z)

    def share(self, total: Tensor) -> Tensor:
        """F of the weighted sum of `below`."""
        return total / 2 if self.deep else (total + 1) / 2

    def integral(self, value: Tensor | float) -> Tensor:
        """G at values, shape [N]."""
        return self._added_integral(*self._terms(value))

    def around(self, value: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """F, its density, the standard deviation of the components that make it up
        there, and G; each of shape [N].
        """
        z, below, density = self._terms(value)
        share, slope, mass = (
            added(self.weights * term)
            for term in (below, density * self.scales, density)
        )
        return (
            self.share(share),
            slope,
            math.sqrt(0.5) * mass / slope,
            self._added_integral(z, below, density),
        )

    def _terms(self, value: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
        """z, `below(z)` and exp(−z²) / √π of each component, shape [K, N]."""
        z = (value - self.means) * self.scales
        return z, self.below(z), (-z * z).exp() / math.sqrt(math.pi)

    def _added_integral(self, z: Tensor, below: Tensor, density: Tensor) -> Tensor:
        """G, the sum of w (z (1 + below) / 2 + density / 2) / scale, shape [N]."""
        terms = torch.addcmul(density, z, below if self.deep else below + 1) / (
            2 * self.scales
        )
        return added(self.weights * terms)

    def select(self, which: Tensor) -> "Cells":
        """Keeps some cells, by index."""
        weights, means, scales = (
            v.index_select(1, which) for v in (self.weights, self.means, self.scales)
        )
        return Cells(weights, means, scales, self.deep)

    def float(self) -> "Cells":
        """In float32."""
        return Cells(self.weights.float(), self.means.float(), self.scales.float())


def mean(cells: Cells) -> Tensor:
    """Computes E[λ], with its gradient in the parameters, shape [N]."""
    # rounding is by up to 1e-16
    return (1 - (cells.integral(1.0) - cells.integral(0.0))).clamp(0, 1)


@torch.no_grad()
def value_at_risk(cells: Cells, tail: Tensor) -> Tensor:
    """Finds clip(F⁻¹(tail), 0, 1), exact at 0 and 1.

    Args:
        cells: in float64.
        tail: p in (0, 1), shape [N].
    """
    root = _root(cells, tail, _first_root(cells, tail), is_var=True)
    return torch.where(cells.means.isnan().any(0), torch.nan, root)


def conditional_value_at_risk(cells: Cells, tail: Tensor) -> Tensor:
    """Computes the mean of λ over its lowest share `tail`, with its gradient in the
    parameters.

    Args:
        cells: in float64.
        tail: p in (0, 1), shape [N].
    """
    value = _first_root(cells, tail)
    share, density, std, integral = cells.around(value)
    with torch.no_grad():
        excess = share - tail
        off = excess / density
        is_near = ((excess * off).abs() < _CVAR_ERROR * tail) & (
            off.abs() < _STRAIGHT * std
        )
        far = ~(is_near | _at_an_end(value, excess))
        value = _replaced(value, far, _root, cells, tail, value)
    integral = _replaced(integral, far, Cells.integral, cells, value)
    return (value - (integral - cells.integral(0.0)) / tail).clamp(min=0).minimum(value)


def _may_wait(values: Tensor) -> bool:
    """Return whether reading values is free, as on a CPU."""
    return values.device.type == "cpu"


def _at_an_end(value: Tensor, excess: Tensor) -> Tensor:
    """Tells where the root is beyond 0 or 1."""
    return ((value == 0) & (excess >= 0)) | ((value == 1) & (excess <= 0))


def _replaced(
    values: Tensor,
    which: Tensor,
    work: Callable[..., Tensor],
    cells: Cells,
    *columns: Tensor,
) -> Tensor:
    """Values, shape [N], in some cells replaced by what `work` makes of these cells and
    columns.
    """
    if not _may_wait(values):
        return torch.where(which, work(cells, *columns), values)
    index = which.nonzero().squeeze(1)
    if len(index) == 0:
        return values
    return values.index_copy(
        0, index, work(cells.select(index), *(column[index] for column in columns))
    )


@torch.no_grad()
def _first_root(cells: Cells, tail: Tensor) -> Tensor:
    """Seeks x in [0, 1] with F(x) = tail in float32, a few steps."""
    short, p = cells.float(), tail.float()
    mean = added(short.weights * short.means)
    variance = (
        added(short.weights * (short.means.square() + 0.5 / short.scales.square()))
        - mean.square()
    )
    odds = torch.logit(tail).clamp(-_MOST_ODDS, _MOST_ODDS).float()
    value = (mean + _LOGISTIC_STD * variance.clamp(min=0).sqrt() * odds).clamp(0, 1)
    low, high, slopes = (
        torch.zeros_like(value),
        torch.ones_like(value),
        short.weights * short.scales,
    )
    for count in range(_SHORT_SEARCH):
        _, _, value, low, high = _move(
            short, slopes, p, odds, value, low, high, halve=count == _SHORT_SEARCH - 1
        )
    return value.to(tail)


def _root(cells: Cells, tail: Tensor, value: Tensor, is_var: bool = False) -> Tensor:
    """Seeks x in [0, 1] with F(x) = tail, from values on, until F and, of a VaR, x are
    near or all steps are taken.
    """
    found, left = value.clone(), torch.arange(len(value), device=value.device)
    settled = torch.zeros_like(value, dtype=torch.bool)
    low, high, odds = torch.zeros_like(value), torch.ones_like(value), torch.logit(tail)
    for count in range(_LONG_SEARCH):
        halve, slopes = (
            count >= _FREE_STEPS and count % 2 == 1,
            cells.weights * cells.scales,
        )
        excess, off, moved, low, high = _move(
            cells, slopes, tail, odds, value, low, high, halve
        )
        near = excess.abs() < _SHARE_ERROR * tail
        if is_var:
            near &= off.abs() < _VAR_ERROR
        # Cells with NaN parameters have no root.
        ended = (
            near
            | _at_an_end(value, excess)
            | (high - low < _LEAST_GAP)
            | excess.isnan()
        )
        value = torch.where(ended, value, moved)
        if not _may_wait(value):
            found, settled = torch.where(settled, found, value), settled | ended
            continue
        found[left] = value
        on = (~ended).nonzero().squeeze(1)
        if len(on) == 0:
            break
        cells, left = cells.select(on), left[on]
        tail, odds, value, low, high = (v[on] for v in (tail, odds, value, low, high))
    return found


def _move(
    cells: Cells,
    slopes: Tensor,
    tail: Tensor,
    odds: Tensor,
    value: Tensor,
    low: Tensor,
    high: Tensor,
    halve: bool,
) -> tuple[Tensor, ...]:
    """Takes one step of Newton's method on the log odds of F, or halves the bounds.

    Returns:
        F − tail at the value, and how far off that is by the density; the value and the
        bounds thereafter; each of shape [N].
    """
    z = (value - cells.means).mul_(cells.scales)
    share = cells.share(added(cells.below(z).mul_(cells.weights)))
    reach = _REACH[z.dtype]
    density = added(z.clamp_(-reach, reach).square_().neg_().exp_().mul_(slopes)).div_(
        math.sqrt(math.pi)
    )
    excess = share - tail
    under = excess < 0
    low, high = torch.where(under, value, low), torch.where(under, high, value)
    # not a number where F is 0 or 1
    step = (odds - torch.logit(share)) * (share * (1 - share) / density)
    moved = (value + step).clamp(0, 1)
    inside = (moved >= low) & (moved <= high)
    if halve:
        inside &= (step.abs() < 0.1 * (high - low)) & (z.dtype == torch.float32)
    return (
        excess,
        excess / density,
        torch.where(inside, moved, (low + high) / 2),
        low,
        high,
    )


def added(terms: Tensor) -> Tensor:
    """The sum over K, from [K, N] to [N], in one order however many cells there are, as
    `sum` has not.
    """
    total = terms[0].clone()
    for term in terms[1:]:
        total += term
    return total
