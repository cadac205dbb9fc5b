"""Frozen λ: drawn once an episode as a correlated field, each cell with its own distribution.

A field of correlated standard normals goes through each cell's quantile function (`benchnav.core.copula`). Where
ground can immobilise a robot, a field that cuts the start off from the goal is drawn again: what is asked
is which way to take, and there has to be one. Letters in shapes: B episodes, H×W cells.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.copula import LONGEST_CORRELATION, correlated_normal
from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.core.terrain import Terrain
from benchnav.planning.world.places import Places, joined
from benchnav.planning.world.world import World

MOST_ATTEMPTS = 100


def draw_frozen(
    terrain: Terrain, world: World, places: Places, key: int, maps: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Draws the λ of B episodes.

    Args:
        terrain: the true maps.
        world: correlation length, and what immobilises a robot.
        places: starts and goals.
        key: root key of the noise.
        maps: names each episode's stream under that root, B of them.

    Returns:
        λ in [0, 1], shape [B, H, W]; and how many fields of each episode were drawn, int64, shape [B].

    Raises:
        ConfigError: no field of some episode joins its start and goal.
    """
    check_correlation(world, terrain.grid)
    field = torch.zeros_like(terrain.traversability)
    attempts = torch.zeros(len(terrain), dtype=torch.int64, device=field.device)
    pending = torch.arange(len(terrain), device=field.device)
    for attempt in range(MOST_ATTEMPTS):
        normal = _normals(terrain, world, key, [maps[i] for i in pending.tolist()], attempt)
        drawn = terrain.truth.select(pending).from_normal(normal.to(field))
        field = field.index_copy(0, pending, drawn)
        attempts = attempts.index_add(0, pending, torch.ones_like(pending))
        if world.immobile is None:
            return field, attempts
        ways = joined(drawn >= world.immobile.below, terrain.grid, places.select(pending))
        pending = pending[~ways]
        if len(pending) == 0:
            return field, attempts
    raise ConfigError(
        f"Expected ground that joins start and goal, but {MOST_ATTEMPTS} draws of λ gave none for example "
        f"{maps[int(pending[0])]}. Lower `immobile.below`, or take easier maps."
    )


def check_correlation(world: World, grid: Grid) -> None:
    """Refuses a correlation that is too long for the fields of a grid.

    Raises:
        ConfigError: it is.
    """
    longest = LONGEST_CORRELATION * min(grid.extent_m)
    if world.correlation_m > longest:
        raise ConfigError(
            f"Expected `world.correlation_m` of at most {longest:g} m, a quarter of the maps' shorter side, got "
            f"{world.correlation_m:g} m."
        )


def _normals(terrain: Terrain, world: World, key: int, maps: Sequence[int], attempt: int) -> Tensor:
    """Correlated standard normals, float64, shape [M, H, W]; a stream a map and attempt."""
    grid, first = terrain.grid, np.zeros(1, dtype=np.int64)
    cells = world.correlation_m / grid.resolution_m
    fields = [
        correlated_normal(rng.stream_key(key, int(map_index), "field", attempt), first, grid.shape, cells)
        for map_index in maps
    ]
    return torch.from_numpy(np.concatenate(fields))
