"""Random start and goal of each map.

Positions are multiples of 2⁻¹⁰ m, so that single precision represents them exactly.
Letters in shapes: B maps.
"""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from benchnav.core import rng
from benchnav.core.errors import expect
from benchnav.core.grid import Grid

_STEPS_PER_M = 1024  # possible positions per metre
_CANDIDATES = 256  # candidate pairs of start and goal per map


@dataclass(frozen=True, kw_only=True)
class PlacesRule:
    """Rule of random start and goal: uniform inside a margin, at a minimum distance.

    Args:
        least_distance_m: minimum distance between start and goal, in metres, > 0.
        margin_m: minimum distance of start and goal to the map's edges, in metres, ≥ 0.
    """

    least_distance_m: float
    margin_m: float

    def __post_init__(self) -> None:
        """Reject values out of range."""
        in_range = 0 < self.least_distance_m < np.inf and 0 <= self.margin_m < np.inf
        expect(
            in_range,
            "`places` with finite `least_distance_m` > 0 and finite `margin_m` ≥ 0, "
            f"got {self.least_distance_m} and {self.margin_m}.",
        )


def check_places(places: PlacesRule, grid: Grid) -> None:
    """Check that start and goal by a rule fit on maps of a grid.

    Raises:
        ConfigError: If the margin or the minimum distance is too large, or the distance
            is less than a cell's diagonal. The message names the limit.
    """
    _, count = _steps_inside(places, grid)
    half_side_m = min(grid.extent_m) / 2
    has_room = (count >= 1).all()
    expect(
        has_room,
        f"`margin_m` of `places` below {half_side_m:g} m (half of the map's shorter "
        f"side), got {places.margin_m:g} m.",
    )
    largest_steps = np.hypot(*(count - 1))
    largest_m = float(largest_steps) / _STEPS_PER_M
    shown_m = np.floor(100 * largest_m) / 100
    expect(
        places.least_distance_m <= largest_m,
        f"`least_distance_m` of `places` at most {shown_m:g} m (the largest distance "
        f"inside the margin of {places.margin_m:g} m), got {places.least_distance_m:g} "
        "m.",
    )
    diagonal = np.sqrt(2) * grid.resolution_m
    expect(
        places.least_distance_m >= diagonal,
        f"`least_distance_m` of `places` at least {diagonal:.3g} m (a cell's "
        f"diagonal), got {places.least_distance_m:g} m. Start and goal must be in "
        "different cells.",
    )


def draw_places(
    places: PlacesRule, grid: Grid, key: int, indices: ndarray
) -> tuple[ndarray, ndarray]:
    """Draw start and goal of maps.

    The first candidate pair of a map with at least the minimum distance is used. If no
    candidate has it, start and goal lie in opposite corners inside the margin.

    Args:
        places: rule that passes `check_places`.
        grid: grid of the maps.
        key: key of the random stream.
        indices: index of each map's element of the stream, shape [B].

    Returns:
        Start and goal (x, y) in metres, float64, each of shape [B, 2]. Single precision
        represents the values exactly.
    """
    first, count = _steps_inside(places, grid)
    draws = rng.uniform(key, indices, (_CANDIDATES, 2, 2))
    steps = np.floor(draws * count)
    n_maps = len(steps)
    corners = np.broadcast_to([0 * count, count - 1], (n_maps, 1, 2, 2))
    steps = np.concatenate([steps, corners], axis=1)
    pairs_m = (first + steps) / _STEPS_PER_M
    offset_m = pairs_m[:, :, 1] - pairs_m[:, :, 0]
    distance_m = np.hypot(*np.moveaxis(offset_m, -1, 0))
    is_far = distance_m >= places.least_distance_m
    chosen = is_far.argmax(axis=1)
    pair_m = pairs_m[np.arange(n_maps), chosen]
    return pair_m[:, 0], pair_m[:, 1]


def _steps_inside(places: PlacesRule, grid: Grid) -> tuple[float, ndarray]:
    """Return the first step inside the margin, and the number of steps in x and y."""
    first = np.ceil(places.margin_m * _STEPS_PER_M)
    # Upper edges do not belong to the map, so the last step lies below that edge.
    end = np.ceil(np.subtract(grid.extent_m, places.margin_m) * _STEPS_PER_M)
    return first, end - first
