"""The censored Gaussian: observed traversability is the latent plus Gaussian noise, clipped to [0, 1].

Inside (0, 1) an observation has the Gaussian density; at 0 and 1 it has the probability mass of all
that was clipped there. Source: Tobin (1958), "Estimation of relationships for limited dependent
variables".

Many observations at one slope enter the likelihood by five sums, so it is evaluated bin by bin (see
`slope_gp.sums`). Letters in shapes: C classes, B bins.
"""

import math

import numpy as np
import torch
from torch import Tensor

_QUADRATURE_NODES = 12
_NODES, _SHARES = (
    torch.from_numpy(values) for values in np.polynomial.hermite_e.hermegauss(_QUADRATURE_NODES)
)


def expected_log_prob(bins: dict[str, Tensor], mean: Tensor, variance: Tensor, noise: Tensor) -> Tensor:
    """E[log p(observations | f)] under f ~ N(mean, variance), summed over a bin's cells.

    In closed form inside (0, 1); by Gauss-Hermite quadrature at 0 and 1, where the integrand log Φ is
    smooth.

    Args:
        bins: from `SlopeSums.bins`.
        mean: of the latent function at the bins, shape [C, B].
        variance: of the latent function there, shape [C, B].
        noise: variance of the noise, shape [C, 1].

    Returns:
        Shape [C, B].
    """
    square = bins["squares"] - 2 * mean * bins["total"] + bins["inside"] * (mean**2 + variance)
    inside = -0.5 * (square / noise + bins["inside"] * (noise.log() + math.log(2 * math.pi)))
    shares = (_SHARES / _SHARES.sum()).to(mean).view(-1, 1, 1)
    latent = mean + variance.sqrt() * _NODES.to(mean).view(-1, 1, 1)
    below = torch.special.log_ndtr(-latent / noise.sqrt())
    above = torch.special.log_ndtr((latent - 1) / noise.sqrt())
    return inside + (shares * (bins["zeros"] * below + bins["ones"] * above)).sum(0)
