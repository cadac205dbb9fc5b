"""The 8-connected graph of a map's cells, with exact shortest paths for batches.

An edge of the graph is a step from a cell to a neighbour. A diagonal step between two
free cells is closed if the two cells on either side of it are not free, because these
touch at the corner that the step would cross. Cells that are connected by steps are
therefore also connected across shared cell borders. Each map has its own compiled
Dijkstra search: a single search of the batch takes twice as long, because its heap
exceeds the processor's cache.
Letters in shapes: B maps; H×W cells, with flat index row·W + column; E edges.
"""

from collections.abc import Callable, Iterable
from functools import lru_cache, partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

if TYPE_CHECKING:
    from torch import Tensor

NO_CELL = -1  # index that stands for no cell
Cells = TypeVar("Cells", ndarray, "Tensor")
Mask = TypeVar("Mask", ndarray, "Tensor")


@lru_cache(maxsize=8)
def neighbour_pairs(height: int, width: int) -> tuple[ndarray, ndarray, ndarray]:
    """Return the directed edges between 8-connected cells, sorted by target.

    Returns:
        Flat indices of source cells, flat indices of target cells, and edge lengths in
        cell widths (1 or √2), each of shape [E]. The arrays are cached: do not modify
        them.
    """
    indices = np.arange(height * width).reshape(height, width)
    padded = np.pad(indices, 1, constant_values=NO_CELL)
    # The 3×3 cells around each cell.
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    neighbours = windows.reshape(-1, 9)
    row_offset, column_offset = np.indices((3, 3)) - 1
    lengths = np.hypot(row_offset, column_offset).ravel()
    is_edge = (neighbours != NO_CELL) & (lengths > 0)
    target, offset = np.nonzero(is_edge)
    source = neighbours[target, offset]
    return source, target, lengths[offset]


def squeezes(
    free_of: Callable[[Cells], Mask], source: Cells, target: Cells, width: int
) -> Mask:
    """Return a mask of diagonal steps between free cells past two non-free cells.

    Args:
        free_of: function of flat indices that returns whether these cells are free,
            bool.
        source: flat index of the cell that each step leaves, an array or a tensor.
        target: flat index of the cell that each step enters, at most one row and one
            column from `source`, of the same shape.
        width: number of columns W.

    Returns:
        Bool, of the shape that `free_of` returns; False for steps that are not diagonal.
    """
    first_corner = source // width * width + target % width
    second_corner = target // width * width + source % width
    ends_free = free_of(source) & free_of(target)
    return ends_free & ~free_of(first_corner) & ~free_of(second_corner)


def cost_to_go(
    edge_costs: Iterable[ndarray], goals: ndarray, shape: tuple[int, int]
) -> tuple[ndarray, ndarray]:
    """Return the minimum cost from each cell to the nearest goal cell of its map.

    Args:
        edge_costs: for each of B maps, the cost > 0 of each edge of `neighbour_pairs`,
            infinite for closed edges, shape [E].
        goals: mask of goal cells, bool, shape [B, H, W].
        shape: (H, W).

    Returns:
        Cost to go, float64, shape [B, H, W], infinite in cells without a path to a
        goal; and the flat index of the next cell on a shortest path, int64, shape
        [B, H·W], `NO_CELL` at goals and in cells without a path.
    """
    batch = len(goals)
    height, width = shape
    n_cells = height * width
    # The search starts at the goals, so edges are reversed: rows are target cells.
    source, target, _ = neighbour_pairs(height, width)
    columns = source.astype(np.int32)
    row_indices = np.arange(n_cells + 1)
    row_starts = np.searchsorted(target, row_indices).astype(np.int32)
    matrix = np.empty(len(source)), columns, row_starts
    graph = csr_array(matrix, shape=(n_cells, n_cells))
    cost = np.empty((batch, n_cells))
    next_cell = np.empty((batch, n_cells), np.int64)
    # A finite limit excludes infinite edges.
    limit = np.finfo(np.float64).max
    search = partial(
        dijkstra, graph, min_only=True, return_predecessors=True, limit=limit
    )
    maps = zip(edge_costs, goals.reshape(batch, n_cells), strict=True)
    for index, (map_costs, map_goals) in enumerate(maps):
        graph.data = map_costs
        goal_cells = np.flatnonzero(map_goals)
        cost[index], next_cell[index], _ = search(indices=goal_cells)
    next_cell = np.where(next_cell >= 0, next_cell, NO_CELL)
    return cost.reshape(batch, height, width), next_cell


def travel_time_costs(
    traversability: ndarray,
    free: ndarray,
    resolution_m: float,
    closed_corners: bool = True,
) -> ndarray:
    """Return the travel time of each edge at a commanded speed of 1 m/s.

    Half of an edge lies in each of its two cells.

    Args:
        traversability: λ in [0, 1], shape [B, H, W].
        free: mask of free cells, bool, shape [B, H, W].
        resolution_m: edge length of a cell in metres.
        closed_corners: whether the diagonal steps that `squeezes` marks are closed, as
            is the rule since version 1.2.

    Returns:
        Seconds, float64, shape [B, E]; infinite for closed edges and edges of non-free
        cells.
    """
    batch, height, width = traversability.shape
    source, target, length = neighbour_pairs(height, width)
    is_free = free.reshape(batch, -1)
    speed = traversability.reshape(batch, -1)
    pace = np.full((batch, height * width), np.inf)
    np.divide(1.0, speed, out=pace, where=is_free)
    source_pace = np.take(pace, source, axis=1)
    target_pace = np.take(pace, target, axis=1)
    costs = 0.5 * length * resolution_m * (source_pace + target_pace)
    if closed_corners:
        free_of = partial(np.take, is_free, axis=1)
        is_closed = squeezes(free_of, source, target, width)
        costs[is_closed] = np.inf
    return costs
