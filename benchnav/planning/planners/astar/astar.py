"""A*: cheapest paths over the cells of a 2.5D map.

λ̂ does not change during an episode, so the exact cost to go h* is found once for every cell, by one
compiled search, Dijkstra's, backward from the goal, on the host. A* with h* as its heuristic expands the
cells of a cheapest path alone: replanning from wherever the robot stands is following pointers. Ground that
is not free costs its price a metre, on the half of an edge that lies in it, so that every cell has a path.
Sources: Hart, Nilsson and Raphael (1968); paper IV-A1. Letters in shapes: B episodes, H×W cells, N points,
E edges.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchnav import gridgraph
from benchnav.planning.free_space import PRICE
from benchnav.planning.objective import distance
from benchnav.planning.problem import Problem


@dataclass(frozen=True)
class CostToGo:
    """Cheapest paths from every cell to the goal.

    Args:
        cost: metres or seconds to the goal region, prices included, shape [B, H, W].
        following: flat index of the next cell, itself where the path ends, int64, shape [B, H·W].
    """

    cost: Tensor
    following: Tensor


def edge_costs(problem: Problem, by_time: bool = False) -> np.ndarray:
    """Costs of moving between neighbouring cells; works on the host.

    Args:
        problem: B problems.
        by_time: seconds at top speed under λ̂ rather than the 3D length.

    Returns:
        Cost of each edge of `gridgraph.neighbour_pairs`, shape [B, E].
    """
    resolution = problem.grid.resolution_m
    source, target, length = gridgraph.neighbour_pairs(*problem.grid.shape)
    if by_time:
        pace = 1 / (problem.traversability.double() * problem.robot.top_speed_mps)
        costs = 0.5 * length * resolution * _sum_of_ends(pace, source, target)
    else:
        elevation = problem.elevation_m.double().flatten(1).cpu().numpy()
        costs = np.hypot(length * resolution, elevation[:, target] - elevation[:, source])
    return costs + 0.5 * length * resolution * _sum_of_ends(PRICE * ~problem.free, source, target)


def search(problem: Problem, by_time: bool = False) -> CostToGo:
    """Finds cheapest paths to the goal's own cell and to those centred within its radius.

    Works on the host: on another device this copies the maps there and the answer back, once.

    Args:
        problem: B problems.
        by_time: minimise time under λ̂ rather than 3D length.

    Returns:
        Cost to go, of the problem's dtype and device.
    """
    grid, goal_m = problem.grid, problem.goal_m.cpu()
    rows, columns = torch.meshgrid(torch.arange(grid.height), torch.arange(grid.width), indexing="ij")
    centres = torch.stack(grid.centre_of(rows, columns), dim=-1)
    goals = distance(centres, goal_m[:, None, None]) < problem.goal_radius_m
    # On coarse grids no centre may be that near; the goal's own cell always counts.
    row, column = grid.cell_of(goal_m[:, 0], goal_m[:, 1])
    goals[torch.arange(len(problem)), row, column] = True
    cost, following = gridgraph.cost_to_go(edge_costs(problem, by_time), goals.numpy(), grid.shape)
    stay = np.arange(following.shape[1])
    following = np.where(following == gridgraph.NO_CELL, stay, following)
    start = problem.start
    return CostToGo(torch.from_numpy(cost).to(start), torch.from_numpy(following).to(start.device))


def path_cells(field: CostToGo, cell: Tensor, count: int) -> Tensor:
    """Follows cheapest paths.

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


def path_points(problem: Problem, field: CostToGo, state: Tensor, count: int) -> Tensor:
    """Points of the cheapest paths from where the robots stand.

    Args:
        problem: B problems.
        field: from `search`.
        state: shape [B, S].
        count: points to return.

    Returns:
        (x, y) of the robot, of the centre of each cell after its own, and of the goal, repeated, shape
        [B, count, 2].
    """
    grid = problem.grid
    row, column = grid.cell_of(state[:, 0], state[:, 1])
    cells = path_cells(field, row * grid.width + column, count)
    centres = torch.stack(grid.centre_of(cells // grid.width, cells % grid.width), dim=-1).to(state)
    ended = field.following.gather(1, cells) == cells
    points = torch.where(ended[..., None], problem.goal_m[:, None], centres)
    return torch.cat((state[:, None, :2], points[:, 1:]), dim=1)


def _sum_of_ends(maps: Tensor, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Adds the values of maps [B, H, W] in the two cells of each edge, shape [B, E]."""
    values = maps.flatten(1).cpu().numpy()
    return np.take(values, source, axis=1) + np.take(values, target, axis=1)
