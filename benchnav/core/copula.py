"""Fields of spatially correlated standard normal scores.

A field is white noise that is convolved with a kernel ∝ exp(−d²/ℓ²), whose
autocorrelation is exp(−d²/2ℓ²), and divided by the kernel's norm. Each cell is thus
standard normal. The field is computed on a torus of twice the map's extent and cropped.
Fields with a different ℓ or kernel are filtered from the same white noise. The quantile
function of each cell transforms its score to λ, so that marginals are exact: a Gaussian
copula (Nelsen 2006, "An introduction to copulas").

Computations are batched in float64 with NumPy. Results are the same on every machine.
Letters in shapes: B fields; H×W cells.
"""

import numpy as np
from numpy import ndarray

from benchnav.core import rng

KERNELS = ("gaussian", "matern32")
# Maximum ℓ as a fraction of a map's shorter side. With a longer ℓ, opposite borders of
# a map would be visibly correlated, because of the torus.
LONGEST_CORRELATION = 1 / 4
_MATERN32 = 1.3576766739458990  # solves (1 + a) exp(−a) = exp(−1/2)


def correlated_normal(
    key: int,
    indices: ndarray,
    shape: tuple[int, int],
    correlation_cells: float,
    kernel: str = "gaussian",
) -> ndarray:
    """Draw fields of correlated standard normals.

    Args:
        key: key of a random stream; see `rng.stream_key`.
        indices: index of each field in the stream, integers ≥ 0, shape [B].
        shape: (H, W).
        correlation_cells: correlation length ℓ in cells, at most `LONGEST_CORRELATION`
            times the map's shorter side. Cells at distance d have the correlation
            exp(−d²/2ℓ²); if ℓ is 0, they are independent.
        kernel: one of `KERNELS`. The correlation of `matern32` is
            (1 + a d/ℓ) exp(−a d/ℓ) with a = 1.358, so that it is exp(−1/2) at distance
            ℓ, as for the Gaussian kernel.

    Returns:
        Standard normals, float64, shape [B, H, W].
    """
    height, width = shape
    torus = 2 * height, 2 * width
    white = rng.normal(key, indices, torus)
    if correlation_cells == 0:
        return white[:, :height, :width].copy()
    if kernel == "matern32":
        transfer = _matern32(*torus, correlation_cells)
    else:
        down = _gaussian(2 * height, correlation_cells)
        across = _gaussian(2 * width, correlation_cells)
        weights = np.outer(down, across)
        weights /= np.sqrt((weights**2).sum())
        transfer = np.fft.rfft2(weights)
    spectrum = np.fft.rfft2(white) * transfer
    field = np.fft.irfft2(spectrum, s=torus)
    return field[:, :height, :width].copy()


def correlations(size: int, correlation_cells: float) -> ndarray:
    """Return the correlations of `correlated_normal` along one axis.

    The kernel is the Gaussian one. The correlation of two cells is the product of those
    along both axes. For ℓ ≥ 2 cells it is exp(−d²/2ℓ²) within 10⁻³. For smaller ℓ it is
    the autocorrelation of the discrete kernel.

    Args:
        size: number of cells along the axis.
        correlation_cells: correlation length ℓ in cells.

    Returns:
        Correlation by distance in cells, from 1 at distance 0, float64, shape [size].
    """
    if correlation_cells == 0:
        return np.eye(1, size)[0]
    kernel = _gaussian(2 * size, correlation_cells)
    power = np.abs(np.fft.rfft(kernel)) ** 2
    covariances = np.fft.irfft(power, n=2 * size)[:size]
    return covariances / covariances[0]


def _matern32(height: int, width: int, correlation_cells: float) -> ndarray:
    """Return the transfer function: the square root of the correlation's spectrum.

    Its shape is that of `np.fft.rfft2` of a torus of the given height and width.
    """
    distances = np.hypot(_ring(height)[:, None], _ring(width))
    scaled = _MATERN32 * distances / correlation_cells
    correlation = (1 + scaled) * np.exp(-scaled)
    # The correlation has a kink at half the period, so that its spectrum may be
    # slightly negative.
    power = np.fft.rfft2(correlation).real.clip(min=0)
    return np.sqrt(power)


def _gaussian(size: int, correlation_cells: float) -> ndarray:
    """Return exp(−d²/ℓ²) for the distances d of `_ring`, shape [size]."""
    scaled = _ring(size) / correlation_cells
    return np.exp(-(scaled**2))


def _ring(size: int) -> ndarray:
    """Return distances in cells from the first cell of a ring, shape [size]."""
    index = np.arange(size)
    return np.minimum(index, size - index)
