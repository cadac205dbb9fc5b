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

    Because of these weights, coarse octaves dominate.

    Args:
        seed: root seed of the random streams, one stream per octave.
        names: names of the streams, without the octave.
        indices: index of each map's element of the streams, shape [B].
        shape: number of rows and columns, (H, W).
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
        # Random phases shift the lattice differently on each map.
        phase_y = draws[:, 0, None]
        phase_x = draws[:, 1, None]
        rows = (np.arange(height) + 0.5) / period + phase_y
        columns = (np.arange(width) + 0.5) / period + phase_x
        # The noise is Σ fade_y·fade_x·(g_y·Δy + g_x·Δx) over the four lattice points
        # around a position, with gradients g. The sum is separable: gradients are
        # multiplied by weight matrices of rows and columns.
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
        Two arrays, float64, shape [B, N, L], 0 except at the two neighbours of a
        position.
    """
    distance = position[..., None] - np.arange(lattice)
    fade = np.maximum(1 - np.abs(distance), 0)
    weight = fade * fade * fade * (fade * (6 * fade - 15) + 10)
    return weight, weight * distance
