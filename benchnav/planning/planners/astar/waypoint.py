"""Waypoints of local planners: the farthest point of a path to which a straight line
is worth it.

The waypoint is the farthest point of the path, within the look-ahead, whose straight
line costs at most 1.1 times the path under A*'s own costs. Both are integrated exactly
over the cells that they cross, so no corner between two sampled points is missed.
Letters in shapes: B episodes, J lines, N points, H×W cells.
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

# Maximum cost of a straight line relative to the path that it shortens.
_SHORT_CUT = 1.1


@dataclass(frozen=True)
class GroundCosts(Batch):
    """Costs of a metre of straight line in each cell; maps are padded by `Grid.pad`.

    A metre costs path_cost(λ̂, gradient · direction) + penalty_per_m.

    Args:
        grid: size and resolution of the maps.
        path_cost: function of λ̂ and grade that returns the cost of a metre.
        traversability: λ̂, shape [B, (H + 2)·(W + 2)].
        penalty_per_m: penalty of non-free cells, shape [B, (H + 2)·(W + 2)].
        rise_x: rise of a metre along x, shape [B, (H + 2)·(W + 2)].
        rise_y: rise of a metre along y, shape [B, (H + 2)·(W + 2)].
    """

    grid: Grid
    path_cost: Callable[[Tensor, Tensor], Tensor]
    traversability: Tensor
    penalty_per_m: Tensor
    rise_x: Tensor
    rise_y: Tensor


def ground_costs(problem: Problem) -> GroundCosts:
    """Return A*'s own costs of a metre, for B problems."""
    grid = problem.grid
    along_y, along_x = torch.gradient(
        problem.elevation_m, spacing=grid.resolution_m, dim=(1, 2)
    )
    return GroundCosts(
        grid,
        problem.objective.path_cost,
        grid.pad(problem.traversability, outside=1.0),
        grid.pad(PENALTY * (~problem.free).to(problem.risk_map), outside=PENALTY),
        grid.pad(along_x, outside=0.0),
        grid.pad(along_y, outside=0.0),
    )


def line_costs(
    ground: GroundCosts, start_m: Tensor, end_m: Tensor, crossings: int
) -> Tensor:
    """Return the cost of straight lines, integrated over the cells that they cross.

    Args:
        ground: costs of a metre.
        start_m: (x, y) of one end in metres, shape [B, J, 2].
        end_m: (x, y) of the other end, shape [B, J, 2].
        crossings: maximum number of columns, and of rows, that a line enters after its
            first.

    Returns:
        Cost, shape [B, J].
    """
    offset = end_m - start_m
    cuts = _grid_cuts(start_m, offset, ground.grid.resolution_m, crossings)
    fraction = cuts.diff(dim=-1)
    centre = (0.5 * (cuts[..., 1:] + cuts[..., :-1]))[..., None]
    middle = start_m[:, :, None] + centre * offset[:, :, None]
    length = torch.linalg.vector_norm(offset, dim=-1)[..., None]

    def at_pieces(padded: Tensor) -> Tensor:
        return ground.grid.lookup(padded, middle[..., 0], middle[..., 1])

    rise_x = at_pieces(ground.rise_x) * offset[..., :1]
    rise_y = at_pieces(ground.rise_y) * offset[..., 1:]
    # The grade of a line without length does not matter: it costs nothing.
    grade = (rise_x + rise_y) / length.clamp(min=1e-9)
    per_m = ground.path_cost(at_pieces(ground.traversability), grade)
    per_m = per_m + at_pieces(ground.penalty_per_m)
    return (per_m * fraction * length).sum(dim=-1)


def choose_waypoint(
    ground: GroundCosts, points_m: Tensor, lookahead_m: float
) -> tuple[Tensor, Tensor]:
    """Return the farthest point of a path whose straight line costs hardly more than
    the path.

    Args:
        ground: A*'s costs of a metre.
        points_m: the robot, the centres of the next cells of its path, and the goal,
            (x, y) in metres, shape [B, N, 2].
        lookahead_m: look-ahead along the path in metres.

    Returns:
        Waypoint (x, y), shape [B, 2]: the path's next point if no line is worth it; and
        a mask of episodes in which the line to that next point is, bool, shape [B].
    """
    grid = ground.grid
    robot, ahead = points_m[:, :1], points_m[:, 1:]
    # The edge or corner that two cells share is half-way to the next cell's centre.
    gate = 0.5 * (cell_centres(grid, cell_at(grid, robot)).to(robot) + ahead[:, :1])
    count = ahead.shape[1]
    # Straight lines to each point, the path's legs, and the first leg by way of the
    # gate.
    begin = torch.cat((robot.expand_as(ahead), ahead[:, :-1], robot, gate), dim=1)
    end = torch.cat((ahead, ahead[:, 1:], gate, ahead[:, :1]), dim=1)
    # Lines within the look-ahead cross no more columns or rows than this.
    crossings = math.ceil(lookahead_m / grid.resolution_m) + 1
    costs = line_costs(ground, begin, end, crossings)
    lines, legs, by_gate = costs.split((count, count - 1, 2), dim=1)
    # The line to a neighbour across a corner may cut a cell that the path does not
    # touch.
    first = torch.minimum(lines[:, :1], by_gate.sum(dim=1, keepdim=True))
    path = torch.cat((first, legs), dim=1).cumsum(dim=1)
    along_m = torch.linalg.vector_norm(points_m.diff(dim=1), dim=2).cumsum(dim=1)
    in_range = along_m <= lookahead_m
    rank = torch.arange(count, device=ahead.device)
    is_worth = lines <= _SHORT_CUT * path
    farthest = torch.where(is_worth & in_range, rank, 0).amax(dim=1)
    return ahead.take_along_dim(farthest[:, None, None], 1)[:, 0], is_worth[:, 0]


def _grid_cuts(
    start_m: Tensor, offset_m: Tensor, resolution_m: float, crossings: int
) -> Tensor:
    """Return sorted fractions of lines at which they begin, cross grid lines, and end.

    Shape [B, J, 2·crossings + 2].
    """
    lines = torch.arange(crossings, device=start_m.device) + 1
    begin, along = start_m[..., None], offset_m[..., None]
    low = torch.minimum(begin, begin + along)
    crossed = ((low / resolution_m).floor() + lines) * resolution_m
    # A line along an axis never crosses that axis's grid lines: NaN or infinite.
    fractions = ((crossed - begin) / along).nan_to_num(1.0, 1.0, 1.0)
    fractions = fractions.clamp(0, 1).flatten(2)
    ends = torch.zeros_like(fractions[..., :1]), torch.ones_like(fractions[..., :1])
    return torch.cat((*ends, fractions), dim=-1).sort(dim=-1).values
