"""Appearance of terrain: layout of classes by bands of noise, and shaded colours.

Shading follows Lambert's law with ambient light, as in section III-A of Endo et al.
(2024), "BenchNav: Simulation Platform for Benchmarking Off-road Navigation Algorithms
with Probabilistic Traversability". Computations are in NumPy and float64, and results
are the same on every machine. Letters in shapes: B maps, H×W cells, M classes on a map.
"""

import numpy as np
from numpy import ndarray


def class_bands(noise: ndarray, occupancy: ndarray) -> ndarray:
    """Return the band of each cell; bands are intervals of noise values.

    Args:
        noise: smooth noise, shape [B, H, W].
        occupancy: fraction of the cells in each band, shape [M]; sums to 1.

    Returns:
        Band index in [0, M), int64, shape [B, H, W]. The number of cells of a band is
        exact to within one cell.
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
        azimuth_rad: horizontal direction in radians, from the x axis toward the y axis,
            shape [B].
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

    n is the unit normal of the terrain, and l the direction of the light.

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
