"""Check that a robot suits the backend of a world."""

from benchnav.core.errors import expect
from benchnav.core.grid import Grid
from benchnav.planning.problem import Task
from benchnav.planning.world.world import BACKENDS, World


def check_backend(task: Task, world: World, grid: Grid) -> None:
    """Check that the robot of a task suits the backend of a world.

    Args:
        task: the task.
        world: model of λ, with its backend.
        grid: size and resolution of the maps.

    Raises:
        ConfigError: If the backend needs a footprint and the robot has none, or one
            that does not fit the goal's disc or the cells.
    """
    if world.backend == BACKENDS[0]:
        return
    footprint = task.robot.footprint
    backend = f"`world.backend` {world.backend!r}"
    expect(
        footprint is not None,
        f"a robot with a footprint, such as skid_steer, for {backend}, got "
        f"{type(task.robot).__name__}, which is a point.",
    )
    assert footprint is not None
    goal_radius_m = task.rules.goal_radius_m
    expect(
        footprint.radius_m <= goal_radius_m,
        f"a footprint within the goal's disc of {goal_radius_m:g} m, got contacts "
        f"{footprint.radius_m:g} m from the robot's position. Increase "
        "`task.goal_radius_m`.",
    )
    expect(
        grid.resolution_m <= 2 * footprint.track_m,
        f"cells of at most twice the track, {2 * footprint.track_m:g} m, for "
        f"{backend}, got cells of {grid.resolution_m:g} m.",
    )
