"""Slope out of elevation, by Horn's method. Letters in shapes: B maps, H×W cells.

Source: Horn (1981), "Hill shading and the reflectance map".
"""

import numpy as np
from numpy import ndarray


def horn_gradient(framed_m: ndarray, resolution_m: float) -> tuple[ndarray, ndarray]:
    """Estimates ∂z/∂x and ∂z/∂y by Horn's third-order finite differences.

    Args:
        framed_m: elevation with the ground one cell beyond the map, shape [B, H + 2, W + 2]; where that is NaN, not
            known, the surface is continued linearly, so that planes are exact everywhere. See `framed`.
        resolution_m: cell width.

    Returns:
        Two arrays of shape [B, H, W], metres a metre.
    """
    z = _continue_linearly(framed_m)
    pairs_y, pairs_x = z[:, 1:] + z[:, :-1], z[:, :, 1:] + z[:, :, :-1]
    smooth_y, smooth_x = pairs_y[:, 1:] + pairs_y[:, :-1], pairs_x[:, :, 1:] + pairs_x[:, :, :-1]
    along_x = smooth_y[:, :, 2:] - smooth_y[:, :, :-2]
    along_y = smooth_x[:, 2:] - smooth_x[:, :-2]
    return along_x / (8 * resolution_m), along_y / (8 * resolution_m)


def inclination_deg(along_x: ndarray, along_y: ndarray) -> ndarray:
    """Angle between the ground and the horizontal.

    Args:
        along_x: ∂z/∂x, any shape.
        along_y: ∂z/∂y, shape of `along_x`.

    Returns:
        Degrees in [0, 90), shape of `along_x`.
    """
    return np.arctan(np.sqrt(along_x * along_x + along_y * along_y)) * (180 / np.pi)


def framed(elevation_m: ndarray) -> ndarray:
    """Frames maps [B, H, W] with one cell of ground that is not known, NaN, shape [B, H + 2, W + 2]."""
    return np.pad(elevation_m, ((0, 0), (1, 1), (1, 1)), constant_values=np.nan)


def _continue_linearly(framed_m: ndarray) -> ndarray:
    """Where the frame is not known, takes the plane through the two cells next to it."""
    z = framed_m.copy()
    for lines in (z.transpose(2, 0, 1), z.transpose(1, 0, 2)):  # columns, then rows
        for edge, next_to, beyond in ((0, 1, 2), (-1, -2, -3)):
            lines[edge] = np.where(np.isnan(lines[edge]), 2 * lines[next_to] - lines[beyond], lines[edge])
    return z
