"""Maps of 16 m × 16 m with start (3, 8) and goal (13, 8), and the closed loop on them,
for tests.
"""

from typing import Any

import torch
from torch import Tensor

from benchnav.core.grid import Grid
from benchnav.planning.planners.cl_rrt.edges import ClosedLoop
from benchnav.planning.planners.cl_rrt.pursuit import FollowerConfig, PathFollower
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Robot
from tests import factories

GRID = Grid(32, 32, 0.5)


def open_map(batch: int = 1) -> Tensor:
    return torch.full((batch, *GRID.shape), 0.8)


def walled_map(gap: slice | None = None) -> Tensor:
    """A wall 1 m thick at x = 8 m, between start and goal, with or without a gap along
    y.
    """
    maps = open_map()
    maps[:, :, 16:18] = 0.1
    if gap is not None:
        maps[:, gap, 16:18] = 0.8
    return maps


def make_problem(maps: Tensor, robot: Robot | None = None) -> Problem:
    return factories.problem(maps, (3.0, 8.0), (13.0, 8.0), robot=robot)


def make_loop(
    maps: Tensor,
    crossing: bool = False,
    radius_m: float = 1.0,
    robot: Robot | None = None,
    **changes: Any,
) -> ClosedLoop:
    problem = make_problem(maps, robot)
    values = {"step_m": 5.0, "edge_time_s": 10.0} | changes
    return ClosedLoop(
        problem=problem,
        follower=PathFollower(FollowerConfig(), problem.robot),
        radius_m=torch.full((len(maps),), radius_m),
        crossing=torch.full((len(maps),), crossing),
        **values,
    )


def known(points: Tensor) -> Tensor:
    return points[~points[..., 0].isnan()]
