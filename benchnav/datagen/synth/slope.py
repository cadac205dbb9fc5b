"""Slope out of elevation, by Horn's method. Letters in shapes: B maps, H×W cells.

Source: Horn (1981), "Hill shading and the reflectance map".
"""

import numpy as np


def horn_gradient(elevation_m: np.ndarray, resolution_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Estimates ∂z/∂x and ∂z/∂y by Horn's third-order finite differences.

    At the border the surface is continued linearly, so that planes are exact everywhere.

    Args:
        elevation_m: shape [B, H, W].
        resolution_m: cell width.

    Returns:
        Two arrays of shape [B, H, W], metres a metre.
    """
    z = _continue_linearly(elevation_m)
    pairs_y, pairs_x = z[:, 1:] + z[:, :-1], z[:, :, 1:] + z[:, :, :-1]
    smooth_y, smooth_x = pairs_y[:, 1:] + pairs_y[:, :-1], pairs_x[:, :, 1:] + pairs_x[:, :, :-1]
    along_x = smooth_y[:, :, 2:] - smooth_y[:, :, :-2]
    along_y = smooth_x[:, 2:] - smooth_x[:, :-2]
    along_x /= 8 * resolution_m
    along_y /= 8 * resolution_m
    return along_x, along_y


def slope_deg(elevation_m: np.ndarray, resolution_m: float) -> np.ndarray:
    """Inclination of the ground by Horn's method, degrees, shape [B, H, W]."""
    return inclination_deg(*horn_gradient(elevation_m, resolution_m))


def inclination_deg(along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
    """Angle between the ground and the horizontal.

    Args:
        along_x: ∂z/∂x, any shape.
        along_y: ∂z/∂y, shape of `along_x`.

    Returns:
        Degrees in [0, 90), shape of `along_x`.
    """
    angle = np.arctan(np.sqrt(along_x * along_x + along_y * along_y))
    angle *= 180 / np.pi
    return angle


def _continue_linearly(elevation_m: np.ndarray) -> np.ndarray:
    """Frames maps with one cell of the plane through the two cells next to it."""
    batch, height, width = elevation_m.shape
    z = np.empty((batch, height + 2, width + 2))
    z[:, 1:-1, 1:-1] = elevation_m
    z[:, 1:-1, 0] = 2 * z[:, 1:-1, 1] - z[:, 1:-1, 2]
    z[:, 1:-1, -1] = 2 * z[:, 1:-1, -2] - z[:, 1:-1, -3]
    z[:, 0] = 2 * z[:, 1] - z[:, 2]
    z[:, -1] = 2 * z[:, -2] - z[:, -3]
    return z
