"""Correlated noise: fields of standard normal numbers that are alike where they are
near.

A field is white noise passed through a kernel ∝ exp(−d²/ℓ²), whose autocorrelation is
exp(−d²/2ℓ²), and divided by the kernel's norm, so that every cell is standard normal.
It is made on twice the extent, as a torus, and cropped. Another ℓ or kernel filters the
same white noise. Each cell's own quantile function then makes λ
of it, so that marginals are exact: a Gaussian copula (Nelsen 2006, "An introduction to
copulas").

Batched NumPy in float64, the same on every machine. Letters in shapes: B fields, H×W
cells.
"""

import numpy as np
from numpy import ndarray

from benchnav.core import rng

KERNELS = ("gaussian", "matern32")
# of a map's shorter side, so that the torus it is made on does not show
LONGEST_CORRELATION = 1 / 4
_MATERN32 = 1.3576766739458990  # solves (1 + a) exp(−a) = exp(−1/2)


def correlated_normal(
    key: int,
    indices: ndarray,
    shape: tuple[int, int],
    correlation_cells: float,
    kernel: str = "gaussian",
) -> ndarray:
    """Draws fields of standard normals.

    Args:
        key: stream key.
        indices: elements of the stream, shape [B].
        shape: (H, W).
        correlation_cells: ℓ in cells: two cells at distance d have the correlation
            exp(−d²/2ℓ²); at 0 every cell is for itself, and callers keep it to
            `LONGEST_CORRELATION`.
        kernel: one of `KERNELS`; of `matern32` the correlation is (1 + a d/ℓ) exp(−a
            d/ℓ), with the a = 1.358 for which it is exp(−1/2) at distance ℓ, as that of
            the Gaussian is.

    Returns:
        Float64, shape [B, H, W].
    """
    height, width = shape
    white = rng.normal(key, indices, (2 * height, 2 * width))
    if correlation_cells == 0:
        return white[:, :height, :width].copy()
    if kernel == "matern32":
        passed = _matern32(2 * height, 2 * width, correlation_cells)
    else:
        bell = np.outer(
            _bell(2 * height, correlation_cells), _bell(2 * width, correlation_cells)
        )
        bell /= np.sqrt((bell**2).sum())
        passed = np.fft.rfft2(bell)
    field = np.fft.irfft2(np.fft.rfft2(white) * passed, s=white.shape[1:])
    return field[:, :height, :width].copy()


def correlations(size: int, correlation_cells: float) -> ndarray:
    """Correlations of a field's cells along one axis, as `correlated_normal` makes them
    with the Gaussian kernel.

    Two cells are correlated by the product over both axes. From ℓ of two cells on it is
    exp(−d²/2ℓ²) within 10⁻³; for less the kernel has few cells, and this is what they
    make.

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


def _matern32(height: int, width: int, correlation_cells: float) -> ndarray:
    """What passes of each frequency on a torus: the square root of the spectrum of the
    correlation.
    """
    down, across = (
        np.minimum(np.arange(size), size - np.arange(size)) for size in (height, width)
    )
    distance = _MATERN32 * np.hypot(down[:, None], across) / correlation_cells
    # Where the torus closes the correlation has a crease, and its spectrum may be a
    # little under 0.
    power = np.fft.rfft2((1 + distance) * np.exp(-distance)).real.clip(min=0)
    return np.sqrt(power)


def _bell(size: int, correlation_cells: float) -> ndarray:
    """exp(−d²/ℓ²) at the distances of cells from the first one on a ring, shape [size]."""
    distance = np.minimum(np.arange(size), size - np.arange(size))
    return np.exp(-((distance / correlation_cells) ** 2))
