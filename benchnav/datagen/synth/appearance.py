"""What terrain looks like: where each class lies, by bands of noise, and its colour shaded by the light.

Shading is Lambert's law with ambient light, as in paper III-A. Batched NumPy in float64, the same on every machine.
Letters in shapes: B maps, H×W cells, M classes that a map shows.

Source: Perlin (2002), "Improving noise".
"""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray

from benchnav.core import rng


def fractal_perlin(
    seed: int,
    names: tuple[rng.Name, ...],
    indices: ndarray,
    shape: tuple[int, int],
    periods: Sequence[float],
) -> ndarray:
    """Sums octaves of Perlin noise, each weighted by its period, so that large shapes dominate.

    Args:
        seed: root of the random streams, one an octave.
        names: of the streams.
        indices: elements of each stream, shape [B].
        shape: (H, W).
        periods: lattice spacing of each octave in cells.

    Returns:
        Noise in about [−0.7, 0.7], float64, shape [B, H, W].
    """
    height, width = shape
    octaves = []
    for octave, period in enumerate(periods):
        lattice = (int(np.ceil(height / period)) + 2, int(np.ceil(width / period)) + 2)
        key = rng.stream_key(seed, *names, octave)
        draws = rng.uniform(key, indices, (lattice[0] * lattice[1] + 2,))
        angle = 2 * np.pi * draws[:, 2:].reshape(-1, *lattice)
        # A random phase, so that the lattice does not stand at the same place in every map.
        rows = (np.arange(height) + 0.5) / period + draws[:, 0, None]
        columns = (np.arange(width) + 0.5) / period + draws[:, 1, None]
        # Σ over a cell's four corners of fade_y·fade_x·(g_y·Δy + g_x·Δx) is separable: the weights of
        # rows and of columns are matrices around the lattice's gradients.
        weight_y, offset_y = _corner_weights(rows, lattice[0])
        weight_x, offset_x = (np.swapaxes(w, 1, 2) for w in _corner_weights(columns, lattice[1]))
        noise = offset_y @ (np.sin(angle) @ weight_x) + weight_y @ (np.cos(angle) @ offset_x)
        octaves.append(period * noise)
    return sum(octaves[1:], octaves[0]) / sum(periods)


def _corner_weights(position: ndarray, lattice: int) -> tuple[ndarray, ndarray]:
    """Fade weights of the lattice points next to each position, alone and times the signed distance.

    Args:
        position: in lattice spacings, shape [B, N].
        lattice: lattice points L.

    Returns:
        Two arrays of shape [B, N, L], zero but at the two neighbours of each position.
    """
    distance = position[..., None] - np.arange(lattice)
    fade = np.maximum(1 - np.abs(distance), 0)
    weight = fade * fade * fade * (fade * (6 * fade - 15) + 10)
    return weight, weight * distance


def class_bands(noise: ndarray, occupancy: ndarray) -> ndarray:
    """Cuts noise at the quantiles that give each band its share of the cells.

    Args:
        noise: shape [B, H, W].
        occupancy: share of each band, summing to 1, shape [M].

    Returns:
        Band index in [0, M), int64, shape [B, H, W]; each share is met to within one cell.
    """
    flat = noise.reshape(len(noise), -1)
    edges = np.round(np.cumsum(occupancy)[:-1] * flat.shape[1]).astype(int)
    levels = np.sort(flat, axis=1)[:, edges[edges < flat.shape[1]]]
    return (flat[:, None] >= levels[:, :, None]).sum(axis=1).reshape(noise.shape)


def light_direction(azimuth_rad: ndarray, height: ndarray) -> ndarray:
    """Unit vectors toward the light.

    Args:
        azimuth_rad: direction in the plane, shape [B].
        height: z of the unit vector, in [0, 1], shape [B].

    Returns:
        (x, y, z), shape [B, 3].
    """
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(azimuth_rad), across * np.sin(azimuth_rad), height], axis=-1)


def shade(along_x: ndarray, along_y: ndarray, light: ndarray, ambient: float) -> ndarray:
    """Brightness of the ground: ambient + (1 − ambient)·max(0, n·l).

    Args:
        along_x: ∂z/∂x, shape [B, H, W].
        along_y: ∂z/∂y, shape [B, H, W].
        light: unit vectors toward the light, shape [B, 3].
        ambient: share of ambient light, in [0, 1].

    Returns:
        Brightness in [0, 1], shape [B, H, W].
    """
    x, y, z = (light[:, k, None, None] for k in range(3))
    cosine = (z - x * along_x - y * along_y) / np.sqrt(1 + along_x * along_x + along_y * along_y)
    return np.maximum(cosine, 0) * (1 - ambient) + ambient


def paint(look: ndarray, colours: ndarray, brightness: ndarray) -> ndarray:
    """Colours each cell by what it shows under the given brightness.

    Args:
        look: number of a colour, such as that of a class, shape [B, H, W].
        colours: RGB in full light, 0–255, shape [N, 3].
        brightness: in [0, 1], shape [B, H, W].

    Returns:
        Image, uint8, shape [B, 3, H, W].
    """
    lit = np.take(colours.T, look, axis=1) * brightness
    return np.moveaxis(np.rint(lit).astype(np.uint8), 0, 1)
