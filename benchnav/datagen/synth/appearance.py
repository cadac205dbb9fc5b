"""Appearance of terrain: layout of classes by bands of noise, and shaded colours.

Shading is Lambert's law with ambient light, as in paper III-A. Batched NumPy in
float64; results are the same on every machine. Letters in shapes: B maps, H×W cells, M
classes that a map shows.
"""

import numpy as np
from numpy import ndarray


def class_bands(noise: ndarray, occupancy: ndarray) -> ndarray:
    """Return bands of noise, cut at the quantiles of the occupancy.

    Args:
        noise: smooth noise, shape [B, H, W].
        occupancy: fraction of the cells of each band, summing to 1, shape [M].

    Returns:
        Band index in [0, M), int64, shape [B, H, W]; each fraction is exact to within
        one cell.
    """
    flat = noise.reshape(len(noise), -1)
    n_cells = flat.shape[1]
    cumulative = np.cumsum(occupancy)[:-1]
    edges = np.round(cumulative * n_cells).astype(int)
    edges = edges[edges < n_cells]
    levels = np.sort(flat, axis=1)[:, edges]
    reaches_level = flat[:, None] >= levels[:, :, None]
    return reaches_level.sum(axis=1).reshape(noise.shape)


def light_direction(azimuth_rad: ndarray, height: ndarray) -> ndarray:
    """Return unit vectors toward the light.

    Args:
        azimuth_rad: direction in the plane in radians, shape [B].
        height: z of the unit vector, in [0, 1], shape [B].

    Returns:
        (x, y, z), shape [B, 3].
    """
    horizontal = np.sqrt(1 - height**2)
    x = horizontal * np.cos(azimuth_rad)
    y = horizontal * np.sin(azimuth_rad)
    return np.stack([x, y, height], axis=-1)


def shade(
    along_x: ndarray, along_y: ndarray, light: ndarray, ambient: float
) -> ndarray:
    """Return the brightness of terrain: ambient + (1 − ambient)·max(0, n·l).

    Args:
        along_x: ∂z/∂x, shape [B, H, W].
        along_y: ∂z/∂y, shape [B, H, W].
        light: unit vectors toward the light, shape [B, 3].
        ambient: fraction of ambient light, in [0, 1].

    Returns:
        Brightness in [0, 1], shape [B, H, W].
    """
    x, y, z = light.T[..., None, None]
    norm = np.sqrt(1 + along_x * along_x + along_y * along_y)
    cosine = (z - x * along_x - y * along_y) / norm
    direct = np.maximum(cosine, 0)
    return direct * (1 - ambient) + ambient


def paint(colours: ndarray, brightness: ndarray) -> ndarray:
    """Return an image of shaded colours.

    Args:
        colours: RGB in full light, 0–255, shape [B, 3, H, W].
        brightness: brightness of each cell, in [0, 1], shape [B, H, W].

    Returns:
        Image, uint8, shape [B, 3, H, W].
    """
    lit = np.moveaxis(colours, 1, 0) * brightness
    image = np.rint(lit, out=lit).astype(np.uint8)
    return np.moveaxis(image, 0, 1)
