"""A*: cheapest paths over the cells of a 2.5D map.

λ̂ does not change during an episode, so the exact cost to go h* is found once for every cell, by one
compiled search, Dijkstra's, backward from the goal, on the host. A* with h* as its heuristic expands the
cells of a cheapest path alone: replanning from wherever the robot stands is following pointers. Ground that
is not free costs its penalty a metre, on the half of an edge that lies in it, so that every cell has a path.
Sources: Hart, Nilsson and Raphael (1968); paper IV-A1. Letters in shapes: B episodes, H×W cells, N points,
E edges.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchnav.core import gridgraph
from benchnav.core.errors import ConfigError
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import distance
from benchnav.planning.problem import Problem


@dataclass(frozen=True)
class CostToGo:
    """Cheapest paths from every cell to the goal.

    Args:
        cost: of the path to the goal region, by the objective's `path_cost`, penalties included, shape [B, H, W].
        following: flat index of the next cell, itself where the path ends, int64, shape [B, H·W].
    """

    cost: Tensor
    following: Tensor


def edge_costs(problem: Problem) -> Tensor:
    """Costs of moving between neighbouring cells, each half of an edge at its own cell's λ̂.

    Args:
        problem: B problems.

    Returns:
        Cost of each edge of `gridgraph.neighbour_pairs`, float64, shape [B, E].

    Raises:
        ConfigError: the objective's `path_cost` is not finite and above 0.
    """
    device = problem.start.device
    source, target, cells = (
        torch.from_numpy(part).to(device) for part in gridgraph.neighbour_pairs(*problem.grid.shape)
    )
    traversability, elevation, not_free = (
        values.double().flatten(1) for values in (problem.traversability, problem.elevation_m, ~problem.free)
    )
    length_m = cells * problem.grid.resolution_m
    grade = (elevation[:, target] - elevation[:, source]) / length_m
    metre = problem.objective.path_cost
    at_source, at_target = metre(traversability[:, source], grade), metre(traversability[:, target], grade)
    for found in (at_source, at_target):
        if not isinstance(found, Tensor) or found.shape != grade.shape:
            got = list(found.shape) if isinstance(found, Tensor) else type(found).__name__
            raise ConfigError(
                f"Expected `path_cost` of {type(problem.objective).__name__} of the shape of λ̂ and grade, "
                f"{list(grade.shape)}, got {got}. Give a cost for each piece of a path."
            )
    least, most = torch.stack((at_source, at_target)).aminmax()
    if not 0 < least <= most < torch.inf:
        raise ConfigError(
            f"Expected `path_cost` of {type(problem.objective).__name__} as finite numbers > 0, got {least:g} "
            f"to {most:g}. Let no metre of a path be free."
        )
    penalty = PENALTY * (not_free[:, source] + not_free[:, target])
    return 0.5 * length_m * (at_source + at_target) + 0.5 * length_m * penalty


def search(problem: Problem) -> CostToGo:
    """Finds cheapest paths to the goal's own cell and to those centred within its radius.

    Works on the host: on another device this copies the maps there and the answer back, once.

    Args:
        problem: B problems.

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
    cost, following = gridgraph.cost_to_go(edge_costs(problem).cpu().numpy(), goals.numpy(), grid.shape)
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
