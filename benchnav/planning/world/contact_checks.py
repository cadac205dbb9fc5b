"""Checks that a robot with several contacts suits the maps and the task."""

from benchnav.core.errors import expect
from benchnav.core.grid import Grid


def check_contacts(
    backend: str, grid: Grid, goal_radius_m: float, radius_m: float, track_m: float
) -> None:
    """Check the contacts of a robot against the goal's disc and the cells.

    Args:
        backend: name of the backend, for messages.
        grid: grid of the maps.
        goal_radius_m: radius of the goal's disc in metres.
        radius_m: largest distance of a contact from the robot's position in metres.
        track_m: distance between left and right contacts in metres.

    Raises:
        ConfigError: If the contacts do not fit the goal's disc or the cells.
    """
    expect(
        radius_m <= goal_radius_m,
        f"a footprint within the goal's disc of {goal_radius_m:g} m, got contacts "
        f"{radius_m:g} m from the robot's position. Increase `task.goal_radius_m`.",
    )
    resolution_m = grid.resolution_m
    expect(
        resolution_m <= 2 * track_m,
        f"cells of at most twice the track, {2 * track_m:g} m, for `world.backend` "
        f"{backend!r}, got cells of {resolution_m:g} m.",
    )
