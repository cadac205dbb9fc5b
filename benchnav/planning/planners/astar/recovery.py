"""Recovery of robots that stall under a local planner.

A robot that its planner has not driven for a second is steered along the path, cell by
cell, until it has left its position. A robot that is driven, but slowed by the terrain,
continues with its planner. Recovery is not part of the paper. Letters in shapes: B
episodes, S state and A action dimensions.
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

# A recovery begins if a robot has moved less than `_STANDING_M` in `_PATIENCE_S`, and
# its mean commanded speed in that time was below the fraction `_IDLE` of its top speed.
_STANDING_M = 0.05
_PATIENCE_S = 1.0
_IDLE = 0.2
# A robot has reached a point of the path within this fraction of a cell's width.
_REACHED = 0.1
# A recovery ends if the robot has moved `_LEFT_M`, or after `_RECOVERY_S`.
_LEFT_M = 0.5
_RECOVERY_S = 20.0


@dataclass(frozen=True)
class Recovery(Batch):
    """Standing times of robots, and the recoveries in progress.

    Args:
        anchor_m: position (x, y) in metres that the robot has not left for `steps`
            steps, shape [B, 2].
        steps: number of these steps, int64, shape [B].
        driven_m: commanded distance in these steps in metres, shape [B].
        active: mask of robots in recovery, bool, shape [B].
        target_m: target (x, y) of the recovery in metres, shape [B, 2].
        cell: flat index of the cell to whose centre the robot drives, int64, shape [B];
            the target is this centre, or a point of the cell's border before it.
    """

    anchor_m: Tensor
    steps: Tensor
    driven_m: Tensor
    active: Tensor
    target_m: Tensor
    cell: Tensor

    @classmethod
    def none(cls, state: Tensor) -> "Recovery":
        """Return the recovery state before the first step, for robot states [B, S]."""
        zero_m = torch.zeros_like(state[:, 0])
        zero = zero_m.long()
        nowhere = torch.full_like(state[:, :2], torch.inf)
        return cls(nowhere, zero, zero_m, zero.bool(), nowhere, zero)


def watch(recovery: Recovery, state: Tensor, action: Tensor, robot: Robot) -> Recovery:
    """Return the recovery state in which recoveries have begun or ended.

    Args:
        recovery: recovery state after the last step.
        state: current robot states, shape [B, S].
        action: next actions of the local planner, whose first dimension is the speed,
            shape [B, A].
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
    driven_m = torch.where(restarts, 0, recovery.driven_m)
    return replace(
        recovery,
        anchor_m=torch.where(restarts[:, None], state[:, :2], recovery.anchor_m),
        steps=torch.where(restarts, 0, recovery.steps + 1),
        driven_m=driven_m + step_m,
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
    """Return the recovery state with the next targets along the path.

    A recovery leads from cell centre to cell centre. Its first target is the centre of
    the next cell. If the line to this centre crosses more expensive terrain, the first
    target is the gate: the middle of the edge, or the corner, that the robot's cell and
    the next cell share. A robot keeps its target until it has reached it.

    Args:
        recovery: state from `watch`, with the targets of the last step.
        begun: mask of robots that were already in recovery in the last step, bool,
            shape [B].
        problem: B problems.
        field: cheapest paths to the goal.
        state: current robot states, shape [B, S].
        straight: mask of robots that can drive straight to the next cell, bool, shape
            [B].
    """
    grid = problem.grid
    arrived = distance(state, recovery.target_m) < _REACHED * grid.resolution_m
    # From a centre, a robot drives to the next centre; from a gate, to `recovery.cell`.
    cells = path_cells(field, recovery.cell, 2)
    points = cell_points(problem, field, cells)
    was_centre = (recovery.target_m == points[:, 0]).all(dim=1)
    index = (arrived & was_centre).long()[:, None]
    cell = cells.gather(1, index)[:, 0]
    next_m = points.take_along_dim(index[..., None], 1)[:, 0]
    target_m = torch.where(arrived[:, None], next_m, recovery.target_m)

    first_cells = path_cells(field, cell_at(grid, state), 2)
    gate_m = 0.5 * cell_centres(grid, first_cells).to(state).sum(dim=1)
    centre_m = cell_points(problem, field, first_cells)[:, 1]
    first_m = torch.where(straight[:, None], centre_m, gate_m)
    return replace(
        recovery,
        target_m=torch.where(begun[:, None], target_m, first_m),
        cell=torch.where(begun, cell, first_cells[:, 1]),
    )
