"""A*: shortest paths over the free cells of a 2.5D map.

λ̂ does not change during an episode, so the exact cost to go h* is found once for every cell, by one
compiled search backward from the goal. A* with h* as its heuristic expands the cells of a shortest
path alone: replanning from wherever the robot stands is following pointers. Sources: Hart, Nilsson
and Raphael (1968); paper IV-A1. Letters in shapes: B episodes, H×W cells, N points.

Free cells lead to free cells only. A robot may stand on a cell that is not free, since the truth
differs from the prediction; from there every neighbour may be entered at a tenfold cost, so that it
leaves by the shortest way and no free cell's path is affected.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchnav import gridgraph
from benchnav.planning.problem import Problem

_LEAVING_FACTOR = 10.0


@dataclass(frozen=True)
class CostToGo:
    """Shortest paths from every cell to the goal.

    Args:
        cost: metres or seconds to the goal region, infinite where no path leads there, shape
            [B, H, W].
        following: flat index of the next cell, itself where the path ends, int64, shape [B, H·W].
    """

    cost: Tensor
    following: Tensor


def edge_costs(problem: Problem, by_time: bool = False) -> np.ndarray:
    """Costs of moving between neighbouring cells.

    Args:
        problem: B problems.
        by_time: seconds at full speed under λ̂ rather than the 3D length.

    Returns:
        Cost of each edge of `gridgraph.neighbour_pairs`, infinite into cells that are not free,
        shape [B, E].
    """
    shape, resolution = problem.grid.shape, problem.grid.resolution_m
    source, target, length = gridgraph.neighbour_pairs(*shape)
    free = problem.free.flatten(1).cpu().numpy()
    if by_time:
        traversability = problem.traversability.double().cpu().numpy().clip(min=1e-3)
        costs = gridgraph.travel_time_costs(traversability, np.ones_like(traversability, bool), resolution)
    else:
        elevation = problem.elevation_m.double().flatten(1).cpu().numpy()
        costs = np.hypot(length * resolution, elevation[:, target] - elevation[:, source])
    costs = np.where(free[:, source], costs, _LEAVING_FACTOR * costs)
    return np.where(free[:, source] & ~free[:, target], np.inf, costs)


def search(problem: Problem, by_time: bool = False) -> CostToGo:
    """Finds shortest paths to the free cells at the goal: its own, and those centred within its radius.

    Args:
        problem: B problems.
        by_time: minimise time under λ̂ rather than 3D length.

    Returns:
        Cost to go, on the device of the problem.
    """
    grid = problem.grid
    rows, columns = torch.meshgrid(torch.arange(grid.height), torch.arange(grid.width), indexing="ij")
    x, y = grid.centre_of(rows, columns)
    goal = problem.goal_m.cpu()[:, :, None, None]
    near = torch.hypot(x - goal[:, 0], y - goal[:, 1]) < problem.goal_radius_m
    # On coarse grids no centre may be that near; the goal's own cell always counts.
    row, column = grid.cell_of(problem.goal_m.cpu()[:, 0], problem.goal_m.cpu()[:, 1])
    near[torch.arange(len(problem)), row, column] = True
    goals = (near & problem.free.cpu()).numpy()
    cost, following = gridgraph.cost_to_go(edge_costs(problem, by_time), goals, grid.shape)
    stay = np.arange(following.shape[1])
    following = np.where(following == gridgraph.NO_CELL, stay, following)
    device = problem.start.device
    return CostToGo(torch.from_numpy(cost).to(device), torch.from_numpy(following).to(device))


def path_cells(field: CostToGo, cell: Tensor, count: int) -> Tensor:
    """Follows shortest paths.

    Args:
        field: from `search`.
        cell: flat index of the first cells, shape [B].
        count: points to return.

    Returns:
        Flat indices from the first cell on, the last repeated, int64, shape [B, count].
    """
    cells = [cell]
    for _ in range(count - 1):
        cells.append(field.following.gather(1, cells[-1][:, None])[:, 0])
    return torch.stack(cells, dim=1)
