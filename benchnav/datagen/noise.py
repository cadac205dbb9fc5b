"""Smooth noise from named random streams, for the layout of classes and layers.

Batched NumPy in float64; results are the same on every machine. Letters in shapes: B
maps, H×W cells.

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
    """Return the mean of octaves of Perlin noise, each weighted by its period.

    Coarse octaves therefore dominate.

    Args:
        seed: root of the random streams, one per octave.
        names: names of the streams.
        indices: index of each map, one element of every stream, shape [B].
        shape: (H, W).
        periods: lattice spacing of each octave in cells.

    Returns:
        Noise in about [−0.7, 0.7], float64, shape [B, H, W].
    """
    height, width = shape
    octaves = []
    for octave, period in enumerate(periods):
        n_rows = int(np.ceil(height / period)) + 2
        n_columns = int(np.ceil(width / period)) + 2
        key = rng.stream_key(seed, *names, octave)
        n_draws = n_rows * n_columns + 2
        draws = rng.uniform(key, indices, (n_draws,))
        lattice = draws[:, 2:].reshape(-1, n_rows, n_columns)
        angle = 2 * np.pi * lattice
        # Random phases, so that the lattice has another position in each map.
        phase_y = draws[:, 0, None]
        phase_x = draws[:, 1, None]
        rows = (np.arange(height) + 0.5) / period + phase_y
        columns = (np.arange(width) + 0.5) / period + phase_x
        # Σ over a cell's four corners of fade_y·fade_x·(g_y·Δy + g_x·Δx) is separable:
        # the lattice's gradients are multiplied by weight matrices of rows and columns.
        weight_y, offset_y = _corner_weights(rows, n_rows)
        weight_x, offset_x = _corner_weights(columns, n_columns)
        noise_y = offset_y @ (np.sin(angle) @ weight_x.swapaxes(1, 2))
        noise_x = weight_y @ (np.cos(angle) @ offset_x.swapaxes(1, 2))
        octaves.append(period * (noise_y + noise_x))
    total = sum(octaves[1:], octaves[0])
    return total / sum(periods)


def _corner_weights(position: ndarray, lattice: int) -> tuple[ndarray, ndarray]:
    """Return fade weights of lattice points, and weights times signed distance.

    Args:
        position: positions in lattice spacings, shape [B, N].
        lattice: L, number of lattice points.

    Returns:
        Two arrays of shape [B, N, L], zero except at the two neighbours of a position.
    """
    distance = position[..., None] - np.arange(lattice)
    fade = np.maximum(1 - np.abs(distance), 0)
    weight = fade * fade * fade * (fade * (6 * fade - 15) + 10)
    return weight, weight * distance
