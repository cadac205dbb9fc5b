"""The worlds of Cai et al.: where vegetation grows, and the two frozen fields of
traction.

A map has 9 × 9 cells of 1 m. Its border of one cell is dirt; a cell inside is
vegetation with a given probability. Linear and angular traction are drawn independently
for each cell, once a trial, and stay.

All draws are named by (seed, map, realisation): every setting and every density meets
the same noise, and more vegetation is the same vegetation and more. Letters in shapes:
M maps.
"""

import numpy as np

from benchnav import Grid
from benchnav.core import rng
from studies.validation.ground import DIRT, VEGETATION

GRID = Grid(9, 9, 1.0)
BORDER_CELLS = 1


def draw_vegetation(seed: int, maps: np.ndarray, density: float) -> np.ndarray:
    """Tells where vegetation grows.

    Args:
        seed: root of all draws.
        maps: which maps, integers ≥ 0, shape [M].
        density: probability of vegetation in a cell that is not of the border.

    Returns:
        Bool, shape [M, 9, 9].
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
    """Draws linear and angular traction.

    Args:
        seed: root of all draws.
        maps: which maps, shape [M].
        realisation: which draw of each map.
        vegetation: where it grows, bool, shape [M, 9, 9].

    Returns:
        λ in [0, 1], the linear field first, shape [M, 2, 9, 9].
    """
    rank = rng.uniform(
        rng.stream_key(seed, "cai", "traction", realisation), maps, (2, *GRID.shape)
    )
    return np.where(vegetation[:, None], VEGETATION.quantile(rank), DIRT.quantile(rank))
