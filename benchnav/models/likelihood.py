"""The censored Gaussian: observed traversability is the latent plus Gaussian noise, clipped to [0, 1].

Inside (0, 1) an observation has the Gaussian density; at 0 and 1 it has the probability mass of all
that was clipped there. Source: Tobin (1958), "Estimation of relationships for limited dependent
variables".

Many observations at one slope enter the likelihood by five sums, so it is evaluated bin by bin. A bin
of width w makes the noise seem larger by |f'|·w/√12 in root mean square; at 0.25° and a fall of 5 %
a degree, 0.004 beside noise of 0.1 or more, that is under 0.1 % of it. Letters in shapes: C classes,
N cells a class, B bins.
"""

import math

import numpy as np
import torch
from torch import Tensor

from benchnav.models.pixels import PixelTable

BIN_DEG = 0.25

_QUADRATURE_NODES = 12
_NODES, _SHARES = (
    torch.from_numpy(values) for values in np.polynomial.hermite_e.hermegauss(_QUADRATURE_NODES)
)


def sum_bins(table: PixelTable, censored: bool) -> dict[str, Tensor]:
    """Sums the cells of each class in bins of slope.

    Args:
        table: cells by class.
        censored: whether λ of 0 and 1 was clipped there; otherwise it counts as any other.

    Returns:
        `slope_deg` (mean of a bin's slopes), `zeros` and `ones` (cells clipped at 0 and 1), `inside`
        (all others), `total` and `squares` (sum of λ and λ² over those), float64, each of shape
        [C, B]; and `count`, the cells of each class in all, shape [C].
    """
    bins = (table.slope_deg / BIN_DEG).long()
    size = int(bins.max()) + 1
    slope, value = table.slope_deg.double(), table.traversability.double()
    used = torch.arange(slope.shape[1], device=slope.device) < table.count.unsqueeze(1)
    zeros, ones = (used & clipped & censored for clipped in (value <= 0, value >= 1))
    inside = used & ~zeros & ~ones

    def add(values: Tensor) -> Tensor:
        start = torch.zeros(len(bins), size, dtype=torch.float64, device=slope.device)
        return start.scatter_add(1, bins, values.double())

    cells, middle = add(used), (torch.arange(size, device=slope.device) + 0.5) * BIN_DEG
    return {
        "slope_deg": torch.where(cells > 0, add(used * slope) / cells.clamp(min=1), middle),
        "zeros": add(zeros),
        "ones": add(ones),
        "inside": add(inside),
        "total": add(inside * value),
        "squares": add(inside * value**2),
        "count": table.count,
    }


def expected_log_prob(bins: dict[str, Tensor], mean: Tensor, variance: Tensor, noise: Tensor) -> Tensor:
    """E[log p(observations | f)] under f ~ N(mean, variance), summed over a bin's cells.

    In closed form inside (0, 1); by Gauss-Hermite quadrature at 0 and 1, where the integrand log Φ is
    smooth.

    Args:
        bins: from `sum_bins`.
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
