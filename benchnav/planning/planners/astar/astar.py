"""A*: cheapest paths over the cells of a 2.5D map.

The exact cost to go h* of every cell is computed once per λ̂ map, on the CPU, by a
compiled Dijkstra search backward from the goal. A* with h* as its heuristic expands
only the cells of a cheapest path. Hence each cell stores the next cell of its path, and
replanning only reads these cells.

An edge connects the centres of two neighbouring cells; half of the edge lies in each
cell. A half in a non-free cell costs the penalty per metre in addition, so that every
cell has a path. A diagonal edge between two non-free cells that touch at its middle
costs the penalty on its whole length (`gridgraph.squeezes`).

Sources: Hart, Nilsson and Raphael (1968); paper IV-A1. Letters in shapes: B episodes,
H×W cells, N cells of a padded map or points of a path, E edges, J positions.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import TypeVar

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import max_pool2d

from benchnav.core import gridgraph
from benchnav.core.batch import Batch
from benchnav.core.errors import ConfigError, expect
from benchnav.core.grid import Grid
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import distance
from benchnav.planning.problem import Problem

Cells = TypeVar("Cells", ndarray, Tensor)  # flat indices of cells
_OFF_MAP_COST = 100 * PENALTY  # cost to go off the map


@dataclass(frozen=True)
class CostToGo(Batch):
    """Cheapest paths from every cell to the goal.

    Args:
        cost: cost of the path to the goal region by the objective's `path_cost`,
            including penalties, shape [B, H, W].
        following: flat index of the next cell of the path, or of the cell itself where
            the path ends, int64, shape [B, H·W].
    """

    cost: Tensor
    following: Tensor


def edge_costs(problem: Problem) -> Tensor:
    """Return the costs of the edges between neighbouring cells.

    The cost of each half of an edge depends on λ̂ of the cell in which it lies.

    Args:
        problem: B problems.

    Returns:
        Cost of each edge of `gridgraph.neighbour_pairs`, float64, shape [B, E].

    Raises:
        ConfigError: If the objective's `path_cost` is not finite and above 0.
    """
    grid = problem.grid
    source, target, cells = gridgraph.neighbour_pairs(*grid.shape)
    length_cells = torch.from_numpy(cells).to(problem.start.device)
    length_m = length_cells * grid.resolution_m
    layers = [partial(_values_at, values.flatten(1)) for values in _layers(problem)]
    return _costs(problem, source, target, length_m, *layers)


def revised_edge_costs(problem: Problem, before: Tensor, changed: Tensor) -> Tensor:
    """Return `edge_costs` after some cells have changed, in less time.

    Only edges near changed cells are computed.

    Args:
        problem: B problems.
        before: costs of edges before the change, float64, shape [B, E]; not modified.
        changed: mask of cells whose λ̂, free mask or elevation changed, bool, shape
            [B, H, W]; at least one cell must have changed.
    """
    grid = problem.grid
    source, target, cells = gridgraph.neighbour_pairs(*grid.shape)
    # All cells on which an edge depends are neighbours of its source. This includes the
    # two cells next to a diagonal edge.
    has_changed_neighbour = max_pool2d(changed.float(), 3, stride=1, padding=1) > 0
    is_affected = _values_at(has_changed_neighbour.flatten(1), source)
    episode, edge = is_affected.nonzero(as_tuple=True)
    first_cell = episode * has_changed_neighbour[0].numel()
    edges = edge.cpu().numpy()
    begin = torch.from_numpy(source[edges]).to(edge.device)
    end = torch.from_numpy(target[edges]).to(edge.device)
    length_cells = torch.from_numpy(cells[edges]).to(edge.device)
    length_m = length_cells * grid.resolution_m
    layers = []
    for values in _layers(problem):
        layers.append(partial(_values_on_maps, values.flatten(), first_cell))
    costs = _costs(problem, begin, end, length_m, *layers)
    return before.index_put((episode, edge), costs)


def _layers(problem: Problem) -> tuple[Tensor, Tensor, Tensor]:
    """Return the maps on which edge costs depend, each of shape [B, H, W]."""
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
    """Return the costs of edges.

    Args:
        problem: B problems.
        source: flat indices of the cells at which the edges begin.
        target: flat indices of the cells at which the edges end.
        length_m: lengths of the edges in metres.
        traversability_of: function of cells that returns their λ̂.
        elevation_of: function of cells that returns their elevation in metres.
        free_of: function of cells that returns whether they are free.

    Returns:
        Costs, float64, of the shape of the functions' results.
    """
    rise_m = elevation_of(target).double() - elevation_of(source).double()
    grade = rise_m / length_m
    source_cost = _cost_per_m(problem, traversability_of(source), grade)
    target_cost = _cost_per_m(problem, traversability_of(target), grade)
    squeezed = gridgraph.squeezes(free_of, source, target, problem.grid.width)
    source_blocked = (~free_of(source)).double()
    target_blocked = (~free_of(target)).double()
    penalty = PENALTY * (source_blocked + target_blocked + 2 * squeezed)
    half_m = 0.5 * length_m
    return half_m * (source_cost + target_cost) + half_m * penalty


def _cost_per_m(problem: Problem, traversability: Tensor, grade: Tensor) -> Tensor:
    """Return the objective's `path_cost` after checks.

    Returns:
        Cost per metre, float64, shape of `grade`.

    Raises:
        ConfigError: If `path_cost` returns another shape, or values that are not finite
            and above 0.
    """
    objective = problem.objective
    cost = objective.path_cost(traversability.double(), grade)
    name = f"`path_cost` of {type(objective).__name__}"
    shape = list(cost.shape) if isinstance(cost, Tensor) else type(cost).__name__
    expect(
        shape == list(grade.shape),
        f"{name} to return a tensor of shape {list(grade.shape)} (like λ̂), got "
        f"{shape}. Return a cost for each segment of a path.",
    )
    min_cost, max_cost = torch.stack(cost.aminmax())
    if not 0 < min_cost <= max_cost < torch.inf:
        raise ConfigError(
            f"Expected {name} to return finite values > 0, got {min_cost:g} to "
            f"{max_cost:g}. Return a cost > 0 per metre."
        )
    return cost


def _values_at(values: Tensor, cells: np.ndarray) -> Tensor:
    """Return the values [B, H·W] at flat indices of cells, shape [B, E].

    On the CPU, NumPy takes a tenth of PyTorch's time.
    """
    if values.device.type == "cpu":
        return torch.from_numpy(np.take(values.numpy(), cells, axis=1))
    index = torch.from_numpy(cells).to(values.device)
    return values[:, index]


def _values_on_maps(values: Tensor, first_cell: Tensor, cells: Tensor) -> Tensor:
    """Return the values of N cells, each on a map of its own, shape [N].

    Args:
        values: values of all cells of all maps, shape [B·H·W].
        first_cell: index in `values` of the first cell of each cell's map, shape [N].
        cells: flat index of each cell on its map, shape [N].
    """
    return values[first_cell + cells]


def search(problem: Problem, costs: Iterable[Tensor] | None = None) -> CostToGo:
    """Return cheapest paths to the goal region.

    The goal region consists of the cell that contains the goal, and of all cells whose
    centre is within the goal radius. The search runs on the CPU. Costs on another
    device are copied to the CPU once, and the result is copied back once.

    Args:
        problem: B problems.
        costs: costs of the edges of each problem, B tensors of shape [E]; None for
            `edge_costs`.

    Returns:
        Cost to go, with the problem's dtype and device.
    """
    grid = problem.grid
    goal_m = problem.goal_m.cpu()
    cells = torch.arange(grid.height * grid.width)
    centres = cell_centres(grid, cells)
    goals = distance(centres, goal_m[:, None]) < problem.goal_radius_m
    # On coarse grids, no centre may be within the goal radius.
    goals.scatter_(1, cell_at(grid, goal_m)[:, None], True)
    if costs is None:
        costs = edge_costs(problem)
    host_costs = (map_costs.cpu().numpy() for map_costs in costs)
    goal_maps = goals.unflatten(1, grid.shape).numpy()
    cost, following = gridgraph.cost_to_go(host_costs, goal_maps, grid.shape)
    is_end = following == gridgraph.NO_CELL
    following = np.where(is_end, cells.numpy(), following)
    start = problem.start
    costs_to_go = torch.from_numpy(cost).to(start)
    return CostToGo(costs_to_go, torch.from_numpy(following).to(start.device))


def pad_costs(problem: Problem, field: CostToGo) -> Tensor:
    """Return padded maps of the cost to go and of the cost per level metre.

    Args:
        problem: B problems.
        field: cheapest paths of the problems.

    Returns:
        Maps for `cost_at`, shape [B, 2, N] with N = (H + 2)·(W + 2).
    """
    traversability = problem.traversability
    level = torch.zeros_like(traversability)
    per_m = problem.objective.path_cost(traversability, level)
    per_m = per_m + PENALTY * ~problem.free
    costs = torch.stack((field.cost, per_m.to(field.cost)), dim=1)
    return problem.grid.pad(costs, outside=_OFF_MAP_COST)


def cost_at(grid: Grid, costs: Tensor, x_m: Tensor, y_m: Tensor) -> Tensor:
    """Return the cost to go from any position.

    A path leads straight from the position to the centre of its cell or of a
    neighbouring cell, and from that centre to the goal. The cost to go is the minimum
    over these centres. As for an edge, the cost per metre of the straight line is the
    mean of the costs per metre of its first and last cell. Hence the cost to go at a
    centre equals the cost to go of the cell (if grades cost nothing), and has no large
    jumps between centres.
    In the goal region it is 0.

    Args:
        grid: grid of the maps.
        costs: padded costs from `pad_costs`, shape [B, 2, N].
        x_m: x of the positions in metres, shape [B, J].
        y_m: y of the positions in metres, shape [B, J].

    Returns:
        Cost to go, shape [B, J].
    """
    size = grid.resolution_m
    to_go, per_m = costs.unbind(1)
    column = (x_m / size).floor()
    row = (y_m / size).floor()
    own_cost = grid.lookup(per_m, x_m, y_m)
    ended = grid.lookup(to_go, x_m, y_m) == 0
    sides = (-0.5, 0.5, 1.5)
    best = torch.full_like(x_m, torch.inf)
    centres = {}
    for up, right in product(sides, sides):
        centres[up, right] = (column + right) * size, (row + up) * size
    cost_per_m = {side: grid.lookup(per_m, *centre) for side, centre in centres.items()}
    for (up, right), (centre_x, centre_y) in centres.items():
        end_cost = cost_per_m[up, right]
        # Two non-free cells that touch at a corner block the diagonal line between
        # them, see `edge_costs`. For a line to a neighbour across an edge, these two
        # cells are the ends of the line, which are not both free.
        min_corner_cost = torch.minimum(cost_per_m[up, 0.5], cost_per_m[0.5, right])
        max_end_cost = torch.maximum(own_cost, end_cost)
        squeezed = (min_corner_cost >= PENALTY) & (max_end_cost < PENALTY)
        length = torch.sqrt((x_m - centre_x) ** 2 + (y_m - centre_y) ** 2)
        mean_cost = 0.5 * (own_cost + end_cost)
        line = length * (mean_cost + PENALTY * squeezed)
        centre_to_go = grid.lookup(to_go, centre_x, centre_y)
        best = torch.minimum(best, centre_to_go + line)
    return torch.where(ended, 0, best)


def cell_at(grid: Grid, state: Tensor) -> Tensor:
    """Return flat indices of the cells at states or positions, int64, shape [*B]."""
    row, column = grid.cell_of(state[..., 0], state[..., 1])
    return row * grid.width + column


def cell_centres(grid: Grid, cell: Tensor) -> Tensor:
    """Return centres (x, y) in metres of cells, from flat indices [*B], [*B, 2]."""
    row = cell // grid.width
    column = cell % grid.width
    return torch.stack(grid.centre_of(row, column), dim=-1)


def path_cells(field: CostToGo, cell: Tensor, count: int) -> Tensor:
    """Return the cells of cheapest paths.

    Args:
        field: cheapest paths.
        cell: flat indices of the first cells, shape [B].
        count: number of cells to return.

    Returns:
        Flat indices, int64, shape [B, count]. They begin with the first cell, and
        repeat the last cell of a path.
    """
    cells = [cell[:, None]]
    for _ in range(count - 1):
        following = field.following.gather(1, cells[-1])
        cells.append(following)
    return torch.cat(cells, dim=1)


def cell_points(problem: Problem, field: CostToGo, cells: Tensor) -> Tensor:
    """Return centres of cells, or the goal where a path ends.

    Args:
        problem: B problems.
        field: cheapest paths.
        cells: flat indices of cells, shape [B, N].

    Returns:
        Points (x, y) in metres, shape [B, N, 2].
    """
    ended = field.following.gather(1, cells) == cells
    centres = cell_centres(problem.grid, cells).to(problem.start)
    return torch.where(ended[..., None], problem.goal_m[:, None], centres)


def path_points(problem: Problem, field: CostToGo, state: Tensor, count: int) -> Tensor:
    """Return points of the cheapest paths from the robots' positions.

    Args:
        problem: B problems.
        field: cheapest paths.
        state: robot states, shape [B, S].
        count: number of points to return.

    Returns:
        Points (x, y) in metres, shape [B, count, 2]: the robot, the centres of the next
        cells, and the goal, which is repeated.
    """
    first_cell = cell_at(problem.grid, state)
    cells = path_cells(field, first_cell, count)
    points = cell_points(problem, field, cells[:, 1:])
    return torch.cat((state[:, None, :2], points), dim=1)
