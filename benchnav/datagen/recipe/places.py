"""Where a map's start and goal lie when they are drawn a map.

Positions are whole steps of 2⁻¹⁰ m, so that single precision holds them as they are.
Letters in shapes: B maps.
"""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from benchnav.core import rng
from benchnav.core.errors import expect
from benchnav.core.grid import Grid

_STEPS_A_M = 1024
_CANDIDATES = 256


@dataclass(frozen=True, kw_only=True)
class PlacesRule:
    """A rule for start and goal: uniform over the map but its margin, and some way
    apart.

    Args:
        least_distance_m: least distance between the two.
        margin_m: least distance of each to the map's edges, ≥ 0.
    """

    least_distance_m: float
    margin_m: float

    def __post_init__(self) -> None:
        """Refuses what is no distance."""
        expect(
            0 < self.least_distance_m < np.inf and 0 <= self.margin_m < np.inf,
            "`places` of finite `least_distance_m` > 0 and `margin_m` ≥ 0, "
            f"got {self.least_distance_m} and {self.margin_m}.",
        )


def check_places(places: PlacesRule, grid: Grid) -> None:
    """Refuses a rule that maps of a grid have no room for.

    Raises:
        ConfigError: with the largest distance that there is room for.
    """
    _, count = _inside(places, grid)
    expect(
        (count >= 1).all(),
        f"`margin_m` of `places` under {min(grid.extent_m) / 2:g} m, half of the "
        "map's shorter side, "
        f"got {places.margin_m:g}.",
    )
    largest = float(np.hypot(*(count - 1))) / _STEPS_A_M
    expect(
        places.least_distance_m <= largest,
        f"`least_distance_m` of `places` of at most {np.floor(100 * largest) / 100:g} "
        "m, the largest distance "
        f"inside the margin of {places.margin_m:g} m, got {places.least_distance_m:g}.",
    )
    diagonal = np.sqrt(2) * grid.resolution_m
    expect(
        places.least_distance_m >= diagonal,
        "`least_distance_m` of `places` of at least a cell's diagonal, "
        f"{diagonal:.3g} m, so that start and goal "
        f"are in two cells, got {places.least_distance_m:g}.",
    )


def draw_places(
    places: PlacesRule, grid: Grid, key: int, indices: ndarray
) -> tuple[ndarray, ndarray]:
    """Draws start and goal of some maps: of a map's candidate pairs the first that is
    far enough apart.

    Where none is, as may be when hardly any two places are so far apart, opposite
    corners are taken.

    Args:
        places: the rule, from `check_places`.
        grid: size of the maps.
        key: stream key.
        indices: which maps of the stream, shape [B].

    Returns:
        Start and goal (x, y) in metres, float64 that single precision holds, each of
        shape [B, 2].
    """
    first, count = _inside(places, grid)
    draws = rng.uniform(key, indices, (_CANDIDATES, 2, 2))
    steps = np.floor(draws * count)
    steps = np.concatenate(
        [steps, np.broadcast_to([0 * count, count - 1], (len(steps), 1, 2, 2))], axis=1
    )
    pairs_m = (first + steps) / _STEPS_A_M
    apart_m = np.hypot(*np.moveaxis(pairs_m[:, :, 1] - pairs_m[:, :, 0], -1, 0))
    chosen = pairs_m[
        np.arange(len(pairs_m)), (apart_m >= places.least_distance_m).argmax(axis=1)
    ]
    return chosen[:, 0], chosen[:, 1]


def _inside(places: PlacesRule, grid: Grid) -> tuple[float, ndarray]:
    """The first step inside the margin along x and along y, and the number of steps
    inside each, shape [2].
    """
    first = np.ceil(places.margin_m * _STEPS_A_M)
    # The map's own upper edges are off the map, so the last step lies under the
    # margin's edge.
    end = np.ceil(np.subtract(grid.extent_m, places.margin_m) * _STEPS_A_M)
    return first, end - first
