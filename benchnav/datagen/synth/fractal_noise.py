"""Gradient noise for class maps. Batched NumPy in float64, the same on every machine.

Source: Perlin (2002), "Improving noise". Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray

from benchnav.core import rng


def perlin(key: int, indices: ndarray, shape: tuple[int, int], period: float) -> ndarray:
    """Draws one octave of Perlin noise a map.

    Args:
        key: stream key.
        indices: elements of the stream, shape [B].
        shape: (H, W).
        period: lattice spacing in cells.

    Returns:
        Noise in about [−0.7, 0.7], float64, shape [B, H, W].
    """
    height, width = shape
    lattice = (int(np.ceil(height / period)) + 2, int(np.ceil(width / period)) + 2)
    draws = rng.uniform(key, indices, (lattice[0] * lattice[1] + 2,))
    angle = 2 * np.pi * draws[:, 2:].reshape(-1, *lattice)
    # A random phase, so that the lattice does not stand at the same place in every map.
    rows = (np.arange(height) + 0.5) / period + draws[:, 0, None]
    columns = (np.arange(width) + 0.5) / period + draws[:, 1, None]
    # Σ over a cell's four corners of fade_y·fade_x·(g_y·Δy + g_x·Δx) is separable: the weights of
    # rows and of columns are matrices around the lattice's gradients.
    weight_y, offset_y = _corner_weights(rows, lattice[0])
    weight_x, offset_x = (np.swapaxes(w, 1, 2) for w in _corner_weights(columns, lattice[1]))
    return offset_y @ (np.sin(angle) @ weight_x) + weight_y @ (np.cos(angle) @ offset_x)


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


def fractal_perlin(
    seed: int,
    names: tuple[rng.Name, ...],
    indices: ndarray,
    shape: tuple[int, int],
    periods: Sequence[float],
) -> ndarray:
    """Sums octaves of Perlin noise, each weighted by its period, so that large shapes dominate.

    Returns:
        Noise, float64, shape [B, H, W].
    """
    octaves = [
        period * perlin(rng.stream_key(seed, *names, octave), indices, shape, period)
        for octave, period in enumerate(periods)
    ]
    return sum(octaves[1:], octaves[0]) / sum(periods)
