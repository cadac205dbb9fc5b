"""A*: cheapest paths over the cells of a 2.5D map.

λ̂ does not change during an episode, so the exact cost to go h* is found once for every
cell, by one compiled search, Dijkstra's, backward from the goal, on the host. A* with
h* as its heuristic expands the
cells of a cheapest path alone: replanning from wherever the robot stands is following
pointers. Ground that is not free costs its penalty a metre, on the half of an edge that
lies in it, so that every cell has a path. A step between two cells that touch at a
corner and are not free costs as much on its whole length (`gridgraph.squeezes`).
Sources: Hart, Nilsson and Raphael (1968); paper IV-A1. Letters in shapes: B episodes,
H×W cells, N points, E edges.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from benchnav.core import gridgraph
from benchnav.core.batch import Batch
from benchnav.core.errors import ConfigError, expect
from benchnav.core.grid import Grid
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import distance
from benchnav.planning.problem import Problem

Cells = TypeVar("Cells", ndarray, Tensor)  # flat indices of cells
_OUTSIDE = 100 * PENALTY  # cost to go off the map, where robots do not move


@dataclass(frozen=True)
class CostToGo(Batch):
    """Cheapest paths from every cell to the goal.

    Args:
        cost: of the path to the goal region, by the objective's `path_cost`, penalties
            included, shape [B, H, W].
        following: flat index of the next cell, itself where the path ends, int64, shape
            [B, H·W].
    """

    cost: Tensor
    following: Tensor


def edge_costs(problem: Problem) -> Tensor:
    """Costs of moving between neighbouring cells, each half of an edge at its own
    cell's λ̂.

    Args:
        problem: B problems.

    Returns:
        Cost of each edge of `gridgraph.neighbour_pairs`, float64, shape [B, E].

    Raises:
        ConfigError: the objective's `path_cost` is not finite and above 0.
    """
    source, target, cells = gridgraph.neighbour_pairs(*problem.grid.shape)
    length_m = (
        torch.from_numpy(cells).to(problem.start.device) * problem.grid.resolution_m
    )
    layers = (partial(_of_cells, values.flatten(1)) for values in _layers(problem))
    return _costs(problem, source, target, length_m, *layers)


def revised_edge_costs(problem: Problem, before: Tensor, changed: Tensor) -> Tensor:
    """Return `edge_costs` where ground has changed in some cells, computed for the
    edges near these.

    Args:
        problem: B problems.
        before: costs of edges before the change, float64, shape [B, E]; they are not
            changed.
        changed: cells whose λ̂, free ground or elevation has changed, one at least,
            bool, shape [B, H, W].
    """
    source, target, cells = gridgraph.neighbour_pairs(*problem.grid.shape)
    # A diagonal step also depends on the two cells next to it, which touch its source.
    near = torch.nn.functional.max_pool2d(changed.float(), 3, stride=1, padding=1) > 0
    member, edge = _of_cells(near.flatten(1), source).nonzero(as_tuple=True)
    of_map, edges = member * near[0].numel(), edge.cpu().numpy()
    begin, end = (
        torch.from_numpy(own[edges]).to(edge.device) for own in (source, target)
    )
    length_m = (
        torch.from_numpy(cells[edges]).to(edge.device) * problem.grid.resolution_m
    )
    layers = (
        partial(_of_flat_cells, values.flatten(), of_map) for values in _layers(problem)
    )
    return before.index_put(
        (member, edge), _costs(problem, begin, end, length_m, *layers)
    )


def _layers(problem: Problem) -> tuple[Tensor, Tensor, Tensor]:
    """What costs of edges depend on, each of shape [B, H, W]."""
    return problem.traversability, problem.elevation_m, problem.free


def _costs(
    problem: Problem,
    source: Cells,
    target: Cells,
    length_m: Tensor,
    traversability_of: Callable[[Cells], Tensor],
    elevation_of: Callable[[Cells], Tensor],
    free_of: Callable[[Cells], Tensor],
) -> Tensor:
    """Costs of some edges, by what tells λ̂, elevation and free ground of cells; of the
    shape that these return.
    """
    traversability, elevation_m, free = (
        [of(own) for own in (source, target)]
        for of in (traversability_of, elevation_of, free_of)
    )
    grade = (elevation_m[1].double() - elevation_m[0].double()) / length_m
    objective = problem.objective
    name = f"`path_cost` of {type(objective).__name__}"
    per_m = [objective.path_cost(values.double(), grade) for values in traversability]
    for cost in per_m:
        got = list(cost.shape) if isinstance(cost, Tensor) else type(cost).__name__
        expect(
            got == list(grade.shape),
            f"{name} of the shape of λ̂ and grade, {list(grade.shape)}, got {got}. "
            "Give a cost for each piece of a "
            "path.",
        )
    least, most = torch.stack([torch.stack(cost.aminmax()) for cost in per_m]).aminmax()
    if not 0 < least <= most < torch.inf:
        raise ConfigError(
            f"Expected {name} as finite numbers > 0, got {least:g} to {most:g}. "
            "Return a cost > 0 per metre."
        )
    squeezed = gridgraph.squeezes(free_of, source, target, problem.grid.width)
    penalty = PENALTY * ((~free[0]).double() + (~free[1]).double() + 2 * squeezed)
    return 0.5 * length_m * (per_m[0] + per_m[1]) + 0.5 * length_m * penalty


def _of_cells(values: Tensor, cells: np.ndarray) -> Tensor:
    """Values [B, H·W] of some cells, shape [B, E]; by NumPy on the host, which takes a
    tenth of PyTorch's time.
    """
    if values.device.type == "cpu":
        return torch.from_numpy(np.take(values.numpy(), cells, axis=1))
    return values[:, torch.from_numpy(cells).to(values.device)]


def _of_flat_cells(values: Tensor, of_map: Tensor, cells: Tensor) -> Tensor:
    """Values [B·H·W] of cells, shape [N], by the first cell of the map of each and its
    place in the map.
    """
    return values[of_map + cells]


def search(problem: Problem, costs: Iterable[Tensor] | None = None) -> CostToGo:
    """Finds cheapest paths to the goal's own cell and to those centred within its
    radius.

    Works on the host: on another device this copies the maps there and the answer back,
    once.

    Args:
        problem: B problems.
        costs: of edges, B of shape [E]; None for `edge_costs`.

    Returns:
        Cost to go, of the problem's dtype and device.
    """
    grid, goal_m = problem.grid, problem.goal_m.cpu()
    centres = cell_centres(grid, torch.arange(grid.height * grid.width))
    goals = distance(centres, goal_m[:, None]) < problem.goal_radius_m
    # On coarse grids no centre may be that near; the goal's own cell always counts.
    goals.scatter_(1, cell_at(grid, goal_m)[:, None], True)
    on_host = (
        of_map.cpu().numpy()
        for of_map in (edge_costs(problem) if costs is None else costs)
    )
    cost, following = gridgraph.cost_to_go(
        on_host, goals.unflatten(1, grid.shape).numpy(), grid.shape
    )
    following = np.where(
        following == gridgraph.NO_CELL, np.arange(following.shape[1]), following
    )
    start = problem.start
    return CostToGo(
        torch.from_numpy(cost).to(start), torch.from_numpy(following).to(start.device)
    )


def framed(problem: Problem, field: CostToGo) -> Tensor:
    """Cost to go, and what a level metre costs in each cell, framed for `cost_at`.

    Args:
        problem: B problems.
        field: their cheapest paths.

    Returns:
        Shape [B, 2, N], N = (H + 2)·(W + 2).
    """
    traversability = problem.traversability
    per_m = problem.objective.path_cost(
        traversability, torch.zeros_like(traversability)
    )
    per_m = per_m + PENALTY * ~problem.free
    return problem.grid.pad(
        torch.stack((field.cost, per_m.to(field.cost)), dim=1), outside=_OUTSIDE
    )


def cost_at(grid: Grid, costs: Tensor, x_m: Tensor, y_m: Tensor) -> Tensor:
    """Cost to go from anywhere: by the centre, of the cell itself or of one next to it,
    that makes it least.

    The straight line to that centre costs what the two cells' metres cost, half and
    half, as an edge does. So at a centre the cost is that of its cell (where grades
    cost nothing), and between them it leaves no steps as large as a cell. In cells
    where paths end it is 0.

    Args:
        grid: of the maps.
        costs: from `framed`, shape [B, 2, N].
        x_m: positions, shape [B, J].
        y_m: positions, shape [B, J].

    Returns:
        Shape [B, J].
    """
    size = grid.resolution_m
    to_go, per_m = costs.unbind(1)
    column, row = (x_m / size).floor(), (y_m / size).floor()
    own, ended = grid.lookup(per_m, x_m, y_m), grid.lookup(to_go, x_m, y_m) == 0
    sides, best = (-0.5, 0.5, 1.5), torch.full_like(x_m, torch.inf)
    centres = {
        (up, right): ((column + right) * size, (row + up) * size)
        for up in sides
        for right in sides
    }
    metre = {side: grid.lookup(per_m, *centre) for side, centre in centres.items()}
    for (up, right), (centre_x, centre_y) in centres.items():
        there = metre[up, right]
        # Cells that touch at a corner and are not free leave no way between them, see
        # `edge_costs`; where they are the cell itself and its neighbour across an edge,
        # one of the ends is not free.
        closed = torch.minimum(metre[up, 0.5], metre[0.5, right]) >= PENALTY
        squeezed = closed & (torch.maximum(own, there) < PENALTY)
        length = torch.sqrt((x_m - centre_x) ** 2 + (y_m - centre_y) ** 2)
        line = length * (0.5 * (own + there) + PENALTY * squeezed)
        best = torch.minimum(best, grid.lookup(to_go, centre_x, centre_y) + line)
    return torch.where(ended, 0, best)


def cell_at(grid: Grid, state: Tensor) -> Tensor:
    """Flat indices of the cells in which states [*B, S] or positions lie, int64, shape
    [*B].
    """
    row, column = grid.cell_of(state[..., 0], state[..., 1])
    return row * grid.width + column


def cell_centres(grid: Grid, cell: Tensor) -> Tensor:
    """(x, y) of the centres of cells, by flat index [*B], shape [*B, 2]."""
    return torch.stack(grid.centre_of(cell // grid.width, cell % grid.width), dim=-1)


def path_cells(field: CostToGo, cell: Tensor, count: int) -> Tensor:
    """Follows cheapest paths.

    Args:
        field: from `search`.
        cell: flat index of the first cells, shape [B].
        count: points to return.

    Returns:
        Flat indices from the first cell on, the last repeated, int64, shape [B, count].
    """
    cells = [cell[:, None]]
    for _ in range(count - 1):
        cells.append(field.following.gather(1, cells[-1]))
    return torch.cat(cells, dim=1)


def cell_points(problem: Problem, field: CostToGo, cells: Tensor) -> Tensor:
    """(x, y) of the centres of cells, of the goal where a path ends, shape [B, N, 2],
    from flat indices [B, N].
    """
    ended = field.following.gather(1, cells) == cells
    centres = cell_centres(problem.grid, cells).to(problem.start)
    return torch.where(ended[..., None], problem.goal_m[:, None], centres)


def path_points(problem: Problem, field: CostToGo, state: Tensor, count: int) -> Tensor:
    """Points of the cheapest paths from where the robots stand.

    Args:
        problem: B problems.
        field: from `search`.
        state: shape [B, S].
        count: points to return.

    Returns:
        (x, y) of the robot, of the centre of each cell after its own, and of the goal,
        repeated, shape [B, count, 2].
    """
    cells = path_cells(field, cell_at(problem.grid, state), count)
    return torch.cat(
        (state[:, None, :2], cell_points(problem, field, cells[:, 1:])), dim=1
    )
