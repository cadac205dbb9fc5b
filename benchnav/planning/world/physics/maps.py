"""Checks of maps for the backend `physics`, which need neither MuJoCo nor a compiler."""

from benchnav.core.errors import expect
from benchnav.core.terrain import Terrain
from benchnav.planning.world.physics.settings import Physics
from benchnav.planning.world.physics.soil import Calibrated


def check_physics_maps(terrain: Terrain, physics: Physics, data: str) -> list[str]:
    """Check maps, and return a warning if the soil lacks the slope laws that it uses.

    Args:
        terrain: maps of a dataset.
        physics: settings of the backend.
        data: id of the dataset.

    Raises:
        ConfigError: If heights are missing, or cells are narrower than a wheel.
    """
    check_heights(terrain, physics)
    soil = physics.law
    is_directional = isinstance(soil, Calibrated) and soil.is_directional
    if not is_directional or terrain.slope_law is not None:
        return []
    return [
        f"maps of {data} have no slope laws of classes, so the soil {soil.name!r} has "
        "the same λ in all directions"
    ]


def check_heights(terrain: Terrain, physics: Physics) -> None:
    """Check heights and resolution.

    Raises:
        ConfigError: If heights are missing, or cells are narrower than a wheel.
    """
    n_missing = int((~terrain.elevation_m.isfinite()).flatten(1).any(1).sum())
    expect(
        n_missing == 0,
        "a height in each cell for `world.backend` 'physics', got missing heights on "
        f"{n_missing} of {len(terrain)} maps. Fill them, or use another backend.",
    )
    width_m = physics.body.wheel_width_m
    resolution_m = terrain.grid.resolution_m
    expect(
        resolution_m >= width_m,
        f"cells at least as wide as a wheel, {width_m:g} m, for `world.backend` "
        f"'physics', got cells of {resolution_m:g} m. Merge cells, or use another "
        "backend.",
    )
