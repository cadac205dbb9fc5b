"""What terrain looks like: where each class lies, and its colour shaded by the light.

Shading is Lambert's law with ambient light, as in paper III-A. Letters in shapes: B maps, H×W
cells, M classes that a map shows.
"""

import numpy as np

from benchnav.datagen.elevation import horn_gradient


def class_bands(noise: np.ndarray, occupancy: np.ndarray) -> np.ndarray:
    """Cuts noise at the quantiles that give each band its share of the cells.

    Args:
        noise: shape [B, H, W].
        occupancy: share of each band, summing to 1, shape [M].

    Returns:
        Band index in [0, M), int64, shape [B, H, W]; each share is met to within one cell.
    """
    flat = noise.reshape(len(noise), -1)
    rank = np.argsort(np.argsort(flat, axis=1, kind="stable"), axis=1, kind="stable")
    edges = np.round(np.cumsum(occupancy)[:-1] * flat.shape[1])
    return np.searchsorted(edges, rank, side="right").reshape(noise.shape)


def light_direction(azimuth_rad: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Unit vectors toward the light.

    Args:
        azimuth_rad: direction in the plane, shape [B].
        height: z of the unit vector, in [0, 1], shape [B].

    Returns:
        (x, y, z), shape [B, 3].
    """
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(azimuth_rad), across * np.sin(azimuth_rad), height], axis=-1)


def shade(elevation_m: np.ndarray, resolution_m: float, light: np.ndarray, ambient: float) -> np.ndarray:
    """Brightness of the ground: ambient + (1 − ambient)·max(0, n·l).

    Args:
        elevation_m: shape [B, H, W].
        resolution_m: cell width.
        light: unit vectors toward the light, shape [B, 3].
        ambient: share of ambient light, in [0, 1].

    Returns:
        Brightness in [0, 1], shape [B, H, W].
    """
    slope_x, slope_y = horn_gradient(elevation_m, resolution_m)
    x, y, z = (light[:, k, None, None] for k in range(3))
    lambert = (z - x * slope_x - y * slope_y) / np.sqrt(1 + slope_x**2 + slope_y**2)
    return ambient + (1 - ambient) * np.maximum(lambert, 0)


def paint(class_id: np.ndarray, colours: np.ndarray, brightness: np.ndarray) -> np.ndarray:
    """Colours each cell by its class under the given brightness.

    Args:
        class_id: shape [B, H, W].
        colours: RGB of each class in full light, 0–255, shape [C, 3].
        brightness: in [0, 1], shape [B, H, W].

    Returns:
        Image, uint8, shape [B, 3, H, W].
    """
    lit = colours[class_id] * brightness[..., None]
    return np.moveaxis(np.round(lit), -1, 1).clip(0, 255).astype(np.uint8)
