"""Terrain of Cai et al.: traction as a mixture of Gaussians, truncated to [0, 1].

They resample values outside [0, 1]. An accepted value has the distribution of the
mixture *given* that it is in [0, 1], whose CDF is

    F(x) = (M(x) − M(0)) / (M(1) − M(0)),  where M is the CDF of the mixture.

A `TraversabilityMixture` is *clipped* instead: values below 0 become 0, which would
give vegetation a mean of 0.36 instead of 0.50. `Ground.slices` therefore cuts the
distribution into 100 parts of equal probability. Point masses at their means form a
mixture of the same mean, and of the same CVaR at every whole per cent.

Source: Cai, Everett, Sharma, Osteen and How (2023), "Probabilistic traversability model
for risk-aware motion planning in off-road environments", IROS;
https://github.com/mit-acl/mppi_numba.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

_BISECTIONS = 50
_BINS = 20
_PERCENT = 100
SLICES = 100


@dataclass(frozen=True)
class Ground:
    """Distribution of traction on one kind of terrain: a mixture of K Gaussians.

    Args:
        weights: weights of the K Gaussians, which sum to 1.
        means: means of the K Gaussians.
        stds: standard deviations of the K Gaussians.
    """

    weights: tuple[float, ...]
    means: tuple[float, ...]
    stds: tuple[float, ...]

    def cdf(self, value: np.ndarray) -> np.ndarray:
        """Return P(λ ≤ value) for values in [0, 1]."""
        nothing, all_ = self._mixture_cdf(np.array([0.0, 1.0]))
        return (self._mixture_cdf(value) - nothing) / (all_ - nothing)

    def quantile(self, probability: np.ndarray) -> np.ndarray:
        """Return the quantile of λ at a probability in [0, 1]."""
        low = np.zeros_like(probability, dtype=float)
        width = 1.0
        for _ in range(_BISECTIONS):
            width /= 2
            low = np.where(self.cdf(low + width) < probability, low + width, low)
        return low + width / 2

    def slices(self) -> np.ndarray:
        """Return the means of λ in 100 parts of equal probability, ascending, [100]."""
        edges = self.quantile(np.arange(1, SLICES) / SLICES)
        return (
            np.diff(self._partial_mean(np.concatenate(([0.0], edges, [1.0])))) * SLICES
        )

    def histogram_cvar(self, fraction: float) -> float:
        """Return their tail mean, from a histogram of 20 bins.

        The tail consists of whole bins, from the lowest until their mass reaches the
        fraction. Its mean is rounded up to the next centre of a bin, which is truncated
        to two decimals. Their histogram has 1 000 draws; here it is exact.

        Args:
            fraction: fraction of the distribution in the lower tail, in (0, 1]; 1 gives
                the mean.
        """
        centres, mass = self._histogram()
        last = np.searchsorted(mass.cumsum(), fraction) if fraction < 1 else _BINS - 1
        tail = slice(0, int(last) + 1)
        mean = (mass[tail] * centres[tail]).sum() / mass[tail].sum()
        return float(np.floor(100 * centres[centres >= mean][0])) / 100

    def histogram_atoms(self) -> np.ndarray:
        """Return the point masses of their sampled fields, lowest first, each of
        probability 1/200, shape [200].

        Their sampler truncates the mass of each bin to whole per cents and assigns the
        remainder to λ = 1. It then rounds 100·u for u uniform in [0, 1], so 0 and 100
        have half the probability of other per cents. The 0 gives λ = 0.
        """
        centres, mass = self._histogram()
        percents = np.floor(_PERCENT * mass + 1e-9).astype(int)
        counts = np.append(percents, _PERCENT - percents.sum())
        values = np.append(np.floor(_PERCENT * centres + 1e-9) / _PERCENT, 1.0)
        by_percent = np.insert(np.repeat(values, counts), 0, 0.0)
        return by_percent.repeat(2)[1:-1]

    def _histogram(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the centres of 20 bins on [0, 1] and their exact masses."""
        edges = np.linspace(0, 1, _BINS + 1)
        return (edges[1:] + edges[:-1]) / 2, np.diff(self.cdf(edges))

    def _mixture_cdf(self, value: np.ndarray) -> np.ndarray:
        return (np.asarray(self.weights) * ndtr(self._standardise(value))).sum(-1)

    def _partial_mean(self, value: np.ndarray) -> np.ndarray:
        """Return E[λ; λ ≤ value] up to a constant."""
        z = self._standardise(value)
        density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
        parts = np.asarray(self.means) * ndtr(z) - np.asarray(self.stds) * density
        nothing, all_ = self._mixture_cdf(np.array([0.0, 1.0]))
        return (np.asarray(self.weights) * parts).sum(-1) / (all_ - nothing)

    def _standardise(self, value: np.ndarray) -> np.ndarray:
        return (value[..., None] - np.asarray(self.means)) / np.asarray(self.stds)


DIRT = Ground((1.0,), (0.65,), (0.1,))
VEGETATION = Ground((0.6, 0.4), (0.0, 0.8), (0.15, 0.1))
