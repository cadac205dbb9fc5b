"""Worlds of Cai et al.: vegetation, and two fixed fields of traction.

A map has 9 × 9 cells of 1 m. Its border of one cell is dirt; a cell inside is
vegetation with a given probability. Linear and angular traction are drawn independently
for each cell, once per episode.

The keys of all draws are (seed, map, realisation), so all settings and densities have
the same noise. A higher density adds vegetation to that of a lower one. Letters in
shapes: M maps.
"""

import numpy as np

from benchnav import Grid
from benchnav.core import rng
from studies.validation.ground import DIRT, VEGETATION

GRID = Grid(9, 9, 1.0)
BORDER_CELLS = 1


def draw_vegetation(seed: int, maps: np.ndarray, density: float) -> np.ndarray:
    """Draw the mask of vegetation.

    Args:
        seed: root of all draws.
        maps: indices of maps, integers ≥ 0, shape [M].
        density: probability of vegetation in a cell inside the border.

    Returns:
        Mask of vegetation, shape [M, 9, 9].
    """
    grown = (
        rng.uniform(rng.stream_key(seed, "cai", "vegetation"), maps, GRID.shape)
        < density
    )
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[BORDER_CELLS:-BORDER_CELLS, BORDER_CELLS:-BORDER_CELLS] = True
    return grown & inside


def draw_traction(
    seed: int, maps: np.ndarray, realisation: int, vegetation: np.ndarray
) -> np.ndarray:
    """Draw linear and angular traction.

    Args:
        seed: root of all draws.
        maps: indices of maps, shape [M].
        realisation: index of the draw.
        vegetation: mask of vegetation, shape [M, 9, 9].

    Returns:
        λ of linear and of angular motion, in [0, 1], shape [M, 2, 9, 9].
    """
    rank = rng.uniform(
        rng.stream_key(seed, "cai", "traction", realisation), maps, (2, *GRID.shape)
    )
    return np.where(vegetation[:, None], VEGETATION.quantile(rank), DIRT.quantile(rank))
