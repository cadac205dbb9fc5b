"""Recovery of robots that a local planner keeps at one position.

If a robot has been kept at one position for a second, it is steered along the path,
cell by cell, until it has left that position. A robot that drives but is slowed by the
terrain is left to its planner. Recovery is not part of
the paper. Letters in shapes: B episodes, S state and A action dimensions.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.planning.objective import distance
from benchnav.planning.planners.astar.astar import (
    CostToGo,
    cell_at,
    cell_centres,
    cell_points,
    path_cells,
)
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Robot

# A robot that has moved less than this
_STANDING_M = 0.05
# for so long,
_PATIENCE_S = 1.0
# at less than this share of its top speed as commanded, is steered along the path,
_IDLE = 0.2
# from one of its points to within this share of a cell's width of the next,
_REACHED = 0.1
# until it is this far away
_LEFT_M = 0.5
# or so much time has passed.
_RECOVERY_S = 20.0


@dataclass(frozen=True)
class Recovery(Batch):
    """Standing times of robots, and the recoveries in progress.

    Args:
        anchor_m: position (x, y) that a robot has not left, shape [B, 2].
        steps: number of steps at that position, int64, shape [B].
        driven_m: commanded distance in these steps, shape [B].
        active: mask of robots in recovery, bool, shape [B].
        target_m: target (x, y) of the recovery, shape [B, 2].
        cell: flat index of the path's cell at or behind the target, int64, shape [B].
    """

    anchor_m: Tensor
    steps: Tensor
    driven_m: Tensor
    active: Tensor
    target_m: Tensor
    cell: Tensor

    @classmethod
    def none(cls, state: Tensor) -> "Recovery":
        """Return the state of robots, shape [B, S], before the first step."""
        zero = torch.zeros_like(state[:, 0])
        nowhere = torch.full_like(state[:, :2], torch.inf)
        return cls(nowhere, zero.long(), zero, zero.bool(), nowhere, zero.long())


def watch(recovery: Recovery, state: Tensor, action: Tensor, robot: Robot) -> Recovery:
    """Return the recovery state with recoveries started and ended.

    Args:
        recovery: state up to the last step.
        state: current robot states, shape [B, S].
        action: next actions of the local planner, the speed first, shape [B, A].
        robot: robot with its time step and top speed.
    """
    limit_m = torch.where(recovery.active, _LEFT_M, _STANDING_M)
    has_left = distance(state, recovery.anchor_m) >= limit_m
    time_s = (recovery.steps + 1) * robot.dt_s
    timed_out = recovery.active & (time_s >= _PATIENCE_S + _RECOVERY_S)
    restarts = has_left | timed_out
    is_idle = recovery.driven_m < _IDLE * robot.top_speed_mps * time_s
    is_standing = (time_s >= _PATIENCE_S) & is_idle
    step_m = action[:, 0].abs() * robot.dt_s
    return replace(
        recovery,
        anchor_m=torch.where(restarts[:, None], state[:, :2], recovery.anchor_m),
        steps=torch.where(restarts, 0, recovery.steps + 1),
        driven_m=torch.where(restarts, 0, recovery.driven_m) + step_m,
        active=~restarts & (recovery.active | is_standing),
    )


def aim(
    recovery: Recovery,
    begun: Tensor,
    problem: Problem,
    field: CostToGo,
    state: Tensor,
    straight: Tensor,
) -> Recovery:
    """Return the recovery state with targets along the path, from cell centre to centre.

    If the line to the next cell crosses more expensive terrain, the cell is reached by
    the corner that the two cells share, which no other cell is part of. A robot keeps
    its target until it is there.

    Args:
        recovery: state from `watch`, with the targets of the last step.
        begun: mask of robots whose recovery began earlier, bool, shape [B].
        problem: B problems.
        field: cheapest paths to the goal.
        state: current robot states, shape [B, S].
        straight: mask of robots whose line to the next cell is worth it, bool, shape [B].

    Returns:
        The recovery with the targets of this step.
    """
    grid = problem.grid
    arrived = distance(state, recovery.target_m) < _REACHED * grid.resolution_m
    ahead = path_cells(field, recovery.cell, 2)
    points = cell_points(problem, field, ahead)
    on = (arrived & (recovery.target_m == points[:, 0]).all(dim=1)).long()[:, None]
    cell = ahead.gather(1, on)[:, 0]
    target = torch.where(
        arrived[:, None],
        points.take_along_dim(on[..., None], 1)[:, 0],
        recovery.target_m,
    )

    ahead = path_cells(field, cell_at(grid, state), 2)
    gate = 0.5 * cell_centres(grid, ahead).to(state).sum(dim=1)
    first_m = torch.where(
        straight[:, None], cell_points(problem, field, ahead)[:, 1], gate
    )
    return replace(
        recovery,
        target_m=torch.where(begun[:, None], target, first_m),
        cell=torch.where(begun, cell, ahead[:, 1]),
    )
