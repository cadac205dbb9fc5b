"""The 8-connected graph over a map's cells, and exact shortest paths in it for a batch of maps.

Maps are searched one by one by a compiled Dijkstra search: the heap of many at once would grow with them.
Letters in shapes: B maps, H×W cells; a cell's flat index is row·W + column.
"""

from functools import lru_cache

import numpy as np
from numpy import ndarray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

NO_CELL = -1


@lru_cache(maxsize=8)
def neighbour_pairs(height: int, width: int) -> tuple[ndarray, ndarray, ndarray]:
    """Lists the directed edges between 8-connected cells, in the order of their targets.

    Returns:
        Flat index of the source cells, of the target cells, and the length of each edge in cell
        widths (1 or √2), each of shape [E]. The arrays are shared: do not write to them.
    """
    index = np.arange(height * width).reshape(height, width)
    padded = np.pad(index, 1, constant_values=NO_CELL)
    # Of each cell the nine around it, row by row.
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(-1, 9)
    lengths = np.hypot(*(np.indices((3, 3)) - 1)).ravel()
    target, place = np.nonzero((around != NO_CELL) & (lengths > 0))
    return around[target, place], target, lengths[place]


def cost_to_go(edge_costs: ndarray, goals: ndarray, shape: tuple[int, int]) -> tuple[ndarray, ndarray]:
    """Finds the least cost from every cell to the nearest goal cell of its own map.

    Args:
        edge_costs: cost > 0 of each edge of `neighbour_pairs`, infinite where it may not be taken,
            shape [B, E].
        goals: goal cells, bool, shape [B, H, W].
        shape: (H, W).

    Returns:
        Cost to go, infinite where no path leads to a goal, shape [B, H, W]; and the flat index of
        the next cell on a shortest path, `NO_CELL` at goals and where there is none, int64, shape
        [B, H·W].
    """
    cells = shape[0] * shape[1]
    # Searching backward from the goals, so the edges are turned round: rows are their targets.
    source, target, _ = neighbour_pairs(*shape)
    first = np.searchsorted(target, np.arange(cells + 1))
    cost, following = np.empty((len(edge_costs), cells)), np.empty((len(edge_costs), cells), dtype=np.int64)
    for own, (costs, starts) in enumerate(zip(edge_costs, goals.reshape(-1, cells), strict=True)):
        graph = csr_array((costs, source, first), shape=(cells, cells))
        # The finite limit keeps infinite edges from being taken.
        cost[own], previous, _ = dijkstra(
            graph,
            indices=np.flatnonzero(starts),
            min_only=True,
            return_predecessors=True,
            limit=np.finfo(np.float64).max,
        )
        following[own] = np.where(previous >= 0, previous, NO_CELL)
    return cost.reshape(-1, *shape), following


def travel_time_costs(traversability: ndarray, free: ndarray, resolution_m: float) -> ndarray:
    """Gives the time each edge takes at a commanded 1 m/s, each half at its own cell's speed.

    Args:
        traversability: share of the commanded speed, shape [B, H, W].
        free: cells that may be entered, bool, shape [B, H, W].
        resolution_m: cell width in metres.

    Returns:
        Seconds, infinite at an edge with an end that is not free, shape [B, E].
    """
    batch, height, width = traversability.shape
    source, target, length = neighbour_pairs(height, width)
    pace = np.full((batch, height * width), np.inf)
    np.divide(1.0, traversability.reshape(batch, -1), out=pace, where=free.reshape(batch, -1))
    return 0.5 * length * resolution_m * (np.take(pace, source, axis=1) + np.take(pace, target, axis=1))
