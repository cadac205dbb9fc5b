"""Mean and CVaR of predicted distributions, computed by operators of ONNX.

F is the distribution function of λ. v is the VaR, found by 40 bisections of [0, 1].
p = 1 − α is the probability of the tail:

    E[λ] = 1 − ∫₀¹ F,    CVaR_α = v − 1/p ∫₀^v F   (see `benchnav.core.cvar`).

The integral of a mixture or of averaged mixtures has a closed form. For a distribution
that a temperature T widens to Φ(Φ⁻¹(F) / T), it is computed by Gauss-Legendre quadrature
on intervals around the mean of each component.
Letters in shapes: B maps, H×W cells, K components, E edges of intervals, *E any leading
dimensions.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from benchnav.core.conditioned import ConditionedDistribution
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.pooled import PooledDistribution
from benchnav.core.quantiles import QuantileDistribution

_N_BISECTIONS = 40
_MIN_STD = 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
# Edges of intervals, in standard deviations from a component's mean.
_DISTANCES = (0.35, 1.0, 1.75, 2.5, 3.5, 5.0, 8.0, 14.0)
_EDGES = (*_DISTANCES, *(-distance for distance in _DISTANCES))
# Beyond these limits, Φ is too small for a normal floating-point number.
_MAX_SCORE = 37.0
_MIN_PROBABILITY = 1e-300
_HART_MAX = 7.07106781186547
_HART_NUMERATOR = (
    3.52624965998911e-02, 0.700383064443688, 6.37396220353165, 33.912866078383, 112.079291497871, 221.213596169931,
    220.206867912376,
)  # fmt: skip
_HART_DENOMINATOR = (
    8.83883476483184e-02, 1.75566716318264, 16.064177579207, 86.7807322029461, 296.564248779674, 637.333633378831,
    793.826512519948, 440.413735824752,
)  # fmt: skip
_ACKLAM_A = (
    -3.969683028665376e01, 2.209460984245205e02, -2.759285104469687e02, 1.383577518672690e02, -3.066479806614716e01,
    2.506628277459239,
)  # fmt: skip
_ACKLAM_B = (
    -5.447609879822406e01, 1.615858368580409e02, -1.556989798598866e02, 6.680131188771972e01, -1.328068155288572e01,
    1.0,
)  # fmt: skip
_ACKLAM_C = (
    -7.784894002430293e-03, -3.223964580411365e-01, -2.400758277161838, -2.549732539343734, 4.374664141464968,
    2.938163982698783,
)  # fmt: skip
_ACKLAM_D = (
    7.784695709041462e-03,
    3.224671290700398e-01,
    2.445134137142996,
    3.754408661907416,
    1.0,
)


def parameters_of(
    distribution: TraversabilityDistribution, prefix: str = ""
) -> dict[str, Tensor]:
    """Return the parameters of a distribution by name.

    If several members do not form one mixture, the names have the form
    `member_1_weights`.

    Args:
        distribution: prediction of a model, shape [B, H, W].
        prefix: start of each name.

    Raises:
        ConfigError: If distributions of this class cannot be exported.
    """
    if isinstance(distribution, TraversabilityMixture):
        return {
            f"{prefix}{name}": getattr(distribution, name)
            for name in ("weights", "means", "stds")
        }
    if isinstance(distribution, QuantileDistribution):
        return {f"{prefix}quantiles": distribution.values}
    if isinstance(distribution, ConditionedDistribution):
        return parameters_of(distribution.base, prefix)
    if isinstance(distribution, PooledDistribution):
        parameters: dict[str, Tensor] = {}
        for number, member in enumerate(distribution.members, 1):
            parameters |= parameters_of(member, f"{prefix}member_{number}_")
        return parameters
    raise ConfigError(
        "Expected a model that predicts a TraversabilityMixture or a "
        "QuantileDistribution, got one that predicts a "
        f"{type(distribution).__name__}, which cannot be exported."
    )


def mean_of(distribution: TraversabilityDistribution) -> Tensor:
    """Return E[λ], shape [B, H, W]."""
    if isinstance(distribution, QuantileDistribution):
        return distribution.mean()
    ones = torch.ones_like(_any_parameter(distribution), dtype=torch.float64)
    return (1 - _integral(distribution, ones)).clamp(0, 1)


def cvar_of(distribution: TraversabilityDistribution, tail: float) -> Tensor:
    """Return the mean of λ over its lowest fraction `tail`, shape [B, H, W]."""
    if tail == 1:
        return mean_of(distribution)
    if isinstance(distribution, QuantileDistribution):
        return distribution.cvar(1 - tail)
    level = torch.full_like(_any_parameter(distribution), tail, dtype=torch.float64)
    value = _quantile(distribution, level)
    return (value - _integral(distribution, value) / tail).clamp(min=0).minimum(value)


def _quantile(distribution: TraversabilityDistribution, level: Tensor) -> Tensor:
    """Return quantiles of λ at levels of shape [B, H, W]."""
    if isinstance(distribution, ConditionedDistribution):
        std = distribution.score_std.double()
        score = distribution.score_mean + std * _normal_score(level)
        return _quantile(distribution.base, _normal_cdf(score))
    # The graph contains each operation of a bisection 40 times, so constants are
    # computed before the loop.
    if isinstance(distribution, TraversabilityMixture):
        weights, means, stds = _mixture(distribution)
        scale = math.sqrt(0.5) / stds
        target = (2 * level - 1).unsqueeze(1)  # Φ = ½ (1 + erf)

        def reaches(value: Tensor) -> Tensor:
            z = ((value - means) * scale).float()
            erf = torch.erf(z).double()  # an operator of ONNX
            return (weights * erf).sum(1, keepdim=True) >= target

    else:

        def reaches(value: Tensor) -> Tensor:
            lower, _ = _tails(distribution, value[:, 0])
            return lower.unsqueeze(1) >= level.unsqueeze(1)

    low = torch.zeros_like(level).unsqueeze(1)
    for step in range(1, _N_BISECTIONS + 1):
        middle = low + 0.5**step
        low = torch.where(reaches(middle), low, middle)
    return low[:, 0] + 0.5**_N_BISECTIONS


def _any_parameter(distribution: TraversabilityDistribution) -> Tensor:
    """Return a parameter; it has the distribution's shape, dtype and device."""
    return next(iter(parameters_of(distribution).values()))[:, 0]


def _mixture(mixture: TraversabilityMixture) -> tuple[Tensor, Tensor, Tensor]:
    """Return weights that sum to 1, means and standard deviations, in float64."""
    weights = mixture.weights.double()
    stds = mixture.stds.double().clamp(min=_MIN_STD)
    return weights / weights.sum(1, keepdim=True), mixture.means.double(), stds


def _tails(distribution: TraversabilityDistribution, value: Tensor) -> Tensor:
    """Return P(λ ≤ value) and P(λ > value), shape [2, *E, B, H, W].

    The second is not computed as 1 minus the first, which would lose digits.
    """
    if isinstance(distribution, PooledDistribution):
        return _average([_tails(member, value) for member in distribution.members])
    if isinstance(distribution, ConditionedDistribution):
        tails = _tails(distribution.base, value)
        scores = _normal_score(tails)
        prior = torch.where(tails[0] < tails[1], scores[0], -scores[1])
        score = (prior - distribution.score_mean) / distribution.score_std.double()
        return _normal_cdf(torch.stack([score, -score]))
    if isinstance(distribution, QuantileDistribution):
        below = distribution.cdf(value).double()
        return torch.stack([below, 1 - below])
    assert isinstance(distribution, TraversabilityMixture)
    weights, means, stds = _mixture(distribution)
    z = (value.unsqueeze(-3) - means) / stds
    return (weights * _normal_cdf(torch.stack([z, -z]))).sum(-3)


def _integral(distribution: TraversabilityDistribution, value: Tensor) -> Tensor:
    """Return the integral of F from 0 to values in [0, 1], shape [B, H, W]."""
    if isinstance(distribution, PooledDistribution):
        return _average([_integral(member, value) for member in distribution.members])
    if isinstance(distribution, TraversabilityMixture):
        weights, means, stds = _mixture(distribution)
        z = torch.stack([-means, value.unsqueeze(1) - means]) / stds
        density = torch.exp(-z * z / 2) / math.sqrt(2 * math.pi)
        below = z * _normal_cdf(z) + density  # integral of Φ up to z
        return (weights * stds * (below[1] - below[0])).sum(1)
    edges = _edges(distribution, value)
    low = edges[:-1]
    width = edges[1:] - edges[:-1]
    # All nodes are computed at once, since a graph of few operations is faster.
    nodes = torch.from_numpy(_NODES).view(-1, 1, 1, 1, 1) / 2
    weights = torch.from_numpy(_WEIGHTS).view(-1, 1, 1, 1, 1) / 2
    heights = _tails(distribution, low + (0.5 + nodes) * width)[0]
    return (weights * width * heights).flatten(0, 1).sum(0)


def _edges(distribution: TraversabilityDistribution, value: Tensor) -> Tensor:
    """Return the edges of intervals in which F is smooth, ascending, [E, B, H, W]."""
    parameters = parameters_of(distribution)
    edges = [torch.stack([torch.zeros_like(value), value])]
    steps = torch.tensor(_EDGES, dtype=torch.float64).view(-1, 1, 1, 1, 1)
    for name, values in parameters.items():
        if name.endswith("means"):
            means = values.double()
            stds = parameters[name.removesuffix("means") + "stds"].double()
            edges.append((means + steps * stds).movedim(2, 1).flatten(0, 1))
    return torch.cat(edges).clamp(min=0).minimum(value).sort(0).values


def _average(values: Sequence[Tensor]) -> Tensor:
    return torch.stack(list(values)).mean(0)


def _normal_cdf(z: Tensor) -> Tensor:
    """Return Φ in float64 with a relative error of 10⁻⁷, even far below 0.

    Source: Hart's approximation in West (2005), "Better approximations to cumulative
    normal functions".
    """
    x = z.abs().clamp(max=_MAX_SCORE)
    fraction = x + 0.65
    for count in (4, 3, 2, 1):
        fraction = x + count / fraction
    ratio = torch.where(
        x < _HART_MAX,
        _polynomial(x, _HART_NUMERATOR) / _polynomial(x, _HART_DENOMINATOR),
        1 / fraction / math.sqrt(2 * math.pi),
    )
    lower = ratio * torch.exp(-0.5 * x * x)
    return torch.where(z > 0, 1 - lower, lower)


def _normal_score(probability: Tensor) -> Tensor:
    """Return Φ⁻¹, which ONNX lacks, with a relative error of 10⁻⁸.

    Source: Acklam (2003), "An algorithm for computing the inverse normal cumulative
    distribution function".
    """
    probability = probability.clamp(_MIN_PROBABILITY, 1 - 2**-53)
    centred = probability - 0.5
    square = centred * centred
    middle = centred * _polynomial(square, _ACKLAM_A) / _polynomial(square, _ACKLAM_B)
    outer = (-2 * probability.minimum(1 - probability).log()).sqrt()
    below = _polynomial(outer, _ACKLAM_C) / _polynomial(outer, _ACKLAM_D)
    tails = torch.where(centred < 0, below, -below)
    return torch.where(centred.abs() < 0.47575, middle, tails)


def _polynomial(x: Tensor, coefficients: Sequence[float]) -> Tensor:
    """Evaluate a polynomial by Horner's scheme; the highest power is first."""
    total = torch.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        total = total * x + coefficient
    return total
