"""Waypoints of local planners, chosen on A*'s path.

The waypoint is the farthest point of the path, within the look-ahead distance, to which
a straight line costs at most 1.1 times as much as the path, by A*'s costs. The costs of
lines and paths are integrated exactly over the cells that they cross, so that even a
short crossing of a cell's corner is counted. Letters in shapes: B episodes, J lines, N
points, H×W cells.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.grid import Grid
from benchnav.planning.free_space import PENALTY
from benchnav.planning.planners.astar.astar import cell_at, cell_centres
from benchnav.planning.problem import Problem

_MAX_COST_RATIO = 1.1  # maximum cost of a straight line, relative to that of the path


@dataclass(frozen=True)
class GroundCosts(Batch):
    """Costs per metre of straight line in each cell, on maps padded by `Grid.pad`.

    The cost per metre is path_cost(λ̂, gradient · direction) + penalty_per_m.

    Args:
        grid: size and resolution of the maps.
        path_cost: function of λ̂ and grade that returns the cost per metre.
        traversability: λ̂, shape [B, (H + 2)·(W + 2)].
        penalty_per_m: penalty of non-free cells, shape [B, (H + 2)·(W + 2)].
        rise_x: rise per metre along x, shape [B, (H + 2)·(W + 2)].
        rise_y: rise per metre along y, shape [B, (H + 2)·(W + 2)].
    """

    grid: Grid
    path_cost: Callable[[Tensor, Tensor], Tensor]
    traversability: Tensor
    penalty_per_m: Tensor
    rise_x: Tensor
    rise_y: Tensor


def ground_costs(problem: Problem) -> GroundCosts:
    """Return A*'s costs per metre on the maps of B problems."""
    grid = problem.grid
    elevation_m = problem.elevation_m
    gradient = torch.gradient(elevation_m, spacing=grid.resolution_m, dim=(1, 2))
    rise_y, rise_x = gradient
    penalty = PENALTY * (~problem.free).to(problem.risk_map)
    return GroundCosts(
        grid,
        problem.objective.path_cost,
        traversability=grid.pad(problem.traversability, outside=1.0),
        penalty_per_m=grid.pad(penalty, outside=PENALTY),
        rise_x=grid.pad(rise_x, outside=0.0),
        rise_y=grid.pad(rise_y, outside=0.0),
    )


def line_costs(
    ground: GroundCosts, start_m: Tensor, end_m: Tensor, crossings: int
) -> Tensor:
    """Return the cost of straight lines, integrated over the cells that they cross.

    Args:
        ground: costs per metre.
        start_m: starts (x, y) of the lines in metres, shape [B, J, 2].
        end_m: ends (x, y) of the lines in metres, shape [B, J, 2].
        crossings: maximum number of columns that a line enters after its first column,
            and of rows that it enters after its first row.

    Returns:
        Cost, shape [B, J].
    """
    offset = end_m - start_m
    cuts = _grid_cuts(start_m, offset, ground.grid.resolution_m, crossings)
    fraction = cuts.diff(dim=-1)
    centre = 0.5 * (cuts[..., 1:] + cuts[..., :-1])
    middle = start_m[:, :, None] + centre[..., None] * offset[:, :, None]
    x, y = middle[..., 0], middle[..., 1]
    length = torch.linalg.vector_norm(offset, dim=-1)[..., None]
    grid = ground.grid
    rise_x = grid.lookup(ground.rise_x, x, y) * offset[..., :1]
    rise_y = grid.lookup(ground.rise_y, x, y) * offset[..., 1:]
    # A line without length costs nothing, whatever its grade.
    grade = (rise_x + rise_y) / length.clamp(min=1e-9)
    traversability = grid.lookup(ground.traversability, x, y)
    per_m = ground.path_cost(traversability, grade)
    per_m = per_m + grid.lookup(ground.penalty_per_m, x, y)
    return (per_m * fraction * length).sum(dim=-1)


def choose_waypoint(
    ground: GroundCosts, points_m: Tensor, lookahead_m: float
) -> tuple[Tensor, Tensor]:
    """Return the waypoint of each path: its farthest point with a cheap straight line.

    A straight line from the robot to a point of its path is cheap if it costs at most
    1.1 times as much as the path to that point.

    Args:
        ground: A*'s costs per metre.
        points_m: points (x, y) in metres, shape [B, N, 2]: the robot, the centres of
            the next cells of its path, and the goal.
        lookahead_m: maximum distance along the path to the waypoint in metres.

    Returns:
        Waypoints (x, y) in metres, shape [B, 2], which are the path's next point if no
        line is cheap; and a mask of episodes in which the line to that next point is
        cheap, bool, shape [B].
    """
    grid = ground.grid
    robot = points_m[:, :1]
    ahead = points_m[:, 1:]
    next_point = ahead[:, :1]
    count = ahead.shape[1]
    # The gate is the middle of the edge, or the corner, that the robot's cell shares
    # with the next cell. It is half-way between their centres.
    centre = cell_centres(grid, cell_at(grid, robot)).to(robot)
    gate = 0.5 * (centre + next_point)
    # Lines from the robot to each point, between successive points of the path, and
    # from the robot to the next point through the gate.
    begin = torch.cat((robot.expand_as(ahead), ahead[:, :-1], robot, gate), dim=1)
    end = torch.cat((ahead, ahead[:, 1:], gate, next_point), dim=1)
    # Maximum number of columns or rows that a line of the look-ahead distance enters.
    crossings = math.ceil(lookahead_m / grid.resolution_m) + 1
    costs = line_costs(ground, begin, end, crossings)
    line_cost, leg_cost, gate_cost = costs.split((count, count - 1, 2), dim=1)
    # The line to a diagonal neighbour may cross a cell that the path does not touch.
    gate_cost = gate_cost.sum(dim=1, keepdim=True)
    first_cost = torch.minimum(line_cost[:, :1], gate_cost)
    path_cost = torch.cat((first_cost, leg_cost), dim=1).cumsum(dim=1)
    leg_m = torch.linalg.vector_norm(points_m.diff(dim=1), dim=2)
    in_range = leg_m.cumsum(dim=1) <= lookahead_m
    rank = torch.arange(count, device=ahead.device)
    is_cheap = line_cost <= _MAX_COST_RATIO * path_cost
    farthest = torch.where(is_cheap & in_range, rank, 0).amax(dim=1)
    waypoint = ahead.take_along_dim(farthest[:, None, None], 1)[:, 0]
    return waypoint, is_cheap[:, 0]


def _grid_cuts(
    start_m: Tensor, offset_m: Tensor, resolution_m: float, crossings: int
) -> Tensor:
    """Return fractions of each line at which it begins, crosses grid lines and ends.

    Returns:
        Fractions in [0, 1], sorted, shape [B, J, 2·crossings + 2].
    """
    count = torch.arange(crossings, device=start_m.device) + 1
    begin = start_m[..., None]
    along = offset_m[..., None]
    low = torch.minimum(begin, begin + along)
    crossed = ((low / resolution_m).floor() + count) * resolution_m
    fractions = (crossed - begin) / along
    # A line parallel to grid lines does not cross them: the fraction is NaN or
    # infinite.
    fractions = fractions.nan_to_num(1.0, 1.0, 1.0)
    fractions = fractions.clamp(0, 1).flatten(2)
    first = torch.zeros_like(fractions[..., :1])
    last = torch.ones_like(first)
    cuts = torch.cat((first, last, fractions), dim=-1)
    return cuts.sort(dim=-1).values
