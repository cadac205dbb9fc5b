"""Gradient noise for class maps. Batched NumPy in float64, the same on every machine.

Source: Perlin (2002), "Improving noise". Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Sequence

import numpy as np

from benchnav import rng


def perlin(key: int, indices: np.ndarray, shape: tuple[int, int], period: float) -> np.ndarray:
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
    rows, columns = (np.arange(n) + 0.5 for n in shape)
    lattice = (int(np.ceil(height / period)) + 2, int(np.ceil(width / period)) + 2)
    draws = rng.uniform(key, indices, (lattice[0] * lattice[1] + 2,))
    angle = 2 * np.pi * draws[:, 2:].reshape(-1, *lattice)
    gradient_y, gradient_x = np.sin(angle), np.cos(angle)
    # A random phase, so that the lattice does not stand at the same place in every map.
    y = rows[None, :, None] / period + draws[:, 0, None, None]
    x = columns[None, None, :] / period + draws[:, 1, None, None]
    row, column = y.astype(np.int64), x.astype(np.int64)
    dy, dx = y - row, x - column
    batch = np.arange(len(draws))[:, None, None]

    def corner(step_y: int, step_x: int) -> np.ndarray:
        at = (batch, row + step_y, column + step_x)
        return gradient_y[at] * (dy - step_y) + gradient_x[at] * (dx - step_x)

    fade_y, fade_x = _fade(dy), _fade(dx)
    top = corner(0, 0) + fade_x * (corner(0, 1) - corner(0, 0))
    bottom = corner(1, 0) + fade_x * (corner(1, 1) - corner(1, 0))
    return top + fade_y * (bottom - top)


def fractal_perlin(
    seed: int,
    names: tuple[rng.Name, ...],
    indices: np.ndarray,
    shape: tuple[int, int],
    periods: Sequence[float],
) -> np.ndarray:
    """Sums octaves of Perlin noise, each weighted by its period, so that large shapes dominate.

    Returns:
        Noise, float64, shape [B, H, W].
    """
    octaves = [
        period * perlin(rng.stream_key(seed, *names, octave), indices, shape, period)
        for octave, period in enumerate(periods)
    ]
    return sum(octaves[1:], octaves[0]) / sum(periods)


def _fade(t: np.ndarray) -> np.ndarray:
    return t * t * t * (t * (6 * t - 15) + 10)
