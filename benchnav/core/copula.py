"""Correlated noise: fields of standard normal numbers that are alike where they are near.

A field is white noise passed through a kernel ∝ exp(−d²/ℓ²), whose autocorrelation is exp(−d²/2ℓ²), and
divided by the kernel's norm, so that every cell is standard normal. It is made on twice the extent, as a
torus, and cropped. Another ℓ filters the same white noise. Each cell's own quantile function then makes λ
of it, so that marginals are exact: a Gaussian copula (Nelsen 2006, "An introduction to copulas").

Batched NumPy in float64, the same on every machine. Letters in shapes: B fields, H×W cells.
"""

import numpy as np
from numpy import ndarray

from benchnav.core import rng

LONGEST_CORRELATION = 1 / 4  # of a map's shorter side, so that the torus it is made on does not show


def correlated_normal(
    key: int, indices: ndarray, shape: tuple[int, int], correlation_cells: float
) -> ndarray:
    """Draws fields of standard normals.

    Args:
        key: stream key.
        indices: elements of the stream, shape [B].
        shape: (H, W).
        correlation_cells: ℓ in cells: two cells at distance d have the correlation exp(−d²/2ℓ²); at 0
            every cell is for itself, and callers keep it to `LONGEST_CORRELATION`.

    Returns:
        Float64, shape [B, H, W].
    """
    height, width = shape
    white = rng.normal(key, indices, (2 * height, 2 * width))
    if correlation_cells == 0:
        return white[:, :height, :width].copy()
    kernel = np.outer(_bell(2 * height, correlation_cells), _bell(2 * width, correlation_cells))
    kernel /= np.sqrt((kernel**2).sum())
    field = np.fft.irfft2(np.fft.rfft2(white) * np.fft.rfft2(kernel), s=white.shape[1:])
    return field[:, :height, :width].copy()


def correlations(size: int, correlation_cells: float) -> ndarray:
    """Correlations of a field's cells along one axis, as `correlated_normal` makes them.

    Two cells are correlated by the product over both axes. From ℓ of two cells on it is exp(−d²/2ℓ²) within 10⁻³; for
    less the kernel has few cells, and this is what they make.

    Args:
        size: number of cells along the axis.
        correlation_cells: ℓ in cells.

    Returns:
        By distance in cells, beginning with 1 at distance 0, shape [size].
    """
    if correlation_cells == 0:
        return np.eye(1, size)[0]
    power = np.abs(np.fft.rfft(_bell(2 * size, correlation_cells))) ** 2
    found = np.fft.irfft(power, n=2 * size)[:size]
    return found / found[0]


def _bell(size: int, correlation_cells: float) -> ndarray:
    """exp(−d²/ℓ²) at the distances of cells from the first one on a ring, shape [size]."""
    distance = np.minimum(np.arange(size), size - np.arange(size))
    return np.exp(-((distance / correlation_cells) ** 2))
