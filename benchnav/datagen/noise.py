"""Smooth noise of named random streams, which classes and layers are laid out by.

Batched NumPy in float64, the same on every machine. Letters in shapes: B maps, H×W
cells.

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
    """Sums octaves of Perlin noise, each weighted by its period, so that large shapes
    dominate.

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
        # A random phase, so that the lattice does not stand at the same place in every
        # map.
        rows = (np.arange(height) + 0.5) / period + draws[:, 0, None]
        columns = (np.arange(width) + 0.5) / period + draws[:, 1, None]
        # Σ over a cell's four corners of fade_y·fade_x·(g_y·Δy + g_x·Δx) is separable:
        # the weights of rows and of columns are matrices around the lattice's
        # gradients.
        weight_y, offset_y = _corner_weights(rows, lattice[0])
        weight_x, offset_x = (
            np.swapaxes(w, 1, 2) for w in _corner_weights(columns, lattice[1])
        )
        noise = offset_y @ (np.sin(angle) @ weight_x) + weight_y @ (
            np.cos(angle) @ offset_x
        )
        octaves.append(period * noise)
    return sum(octaves[1:], octaves[0]) / sum(periods)


def _corner_weights(position: ndarray, lattice: int) -> tuple[ndarray, ndarray]:
    """Fade weights of the lattice points next to each position, alone and times the
    signed distance.

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
