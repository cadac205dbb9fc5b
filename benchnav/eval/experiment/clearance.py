"""Clearance of the draws of a run, which leaves room for its largest footprint.

All conditions of a run then have the same fields, whatever their robot or world.
"""

from collections.abc import Iterable

from benchnav.core.registry import Part
from benchnav.planning.free_space import Rules
from benchnav.planning.world.world import World, split_label


def largest_footprint_m(robots: Iterable[Part]) -> float:
    """Return the radius in metres of the largest footprint; 0 for point robots."""
    largest_m = 0.0
    distinct_robots = {id(robot): robot for robot in robots}
    for robot in distinct_robots.values():
        footprint = robot.object.footprint
        if footprint is not None:
            largest_m = max(largest_m, footprint.radius_m)
    return largest_m


def with_clearance(
    world: World, label: str, rules: Rules, clearance_m: float
) -> tuple[World, str]:
    """Return a world with at least a clearance, and its label.

    Args:
        world: world of a condition.
        label: its label, which also contains changes of the rules.
        rules: rules of the condition.
        clearance_m: clearance in metres; 0 for none.
    """
    wide_world = world.with_clearance(clearance_m)
    if wide_world == world:
        return world, label
    name, changes = split_label(label, rules)
    return wide_world, f"{name} clearance_m={clearance_m:.3g} {changes}".strip()
