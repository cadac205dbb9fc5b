"""The 8-connected graph over a map's cells, and exact shortest paths in it for a batch
of maps.

A diagonal step between two free cells is closed where both cells next to it are not
free: these touch at the corner that the step would pass. So what is joined by steps is
joined over shared edges. Each map has a compiled Dijkstra search to itself: one search
of the whole batch takes twice as long, since its heap leaves the processor's cache.
Letters in shapes: B maps, H×W cells; a cell's flat index is row·W + column.
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

NO_CELL = -1
Cells = TypeVar("Cells", ndarray, "Tensor")
Mask = TypeVar("Mask", ndarray, "Tensor")


@lru_cache(maxsize=8)
def neighbour_pairs(height: int, width: int) -> tuple[ndarray, ndarray, ndarray]:
    """Lists the directed edges between 8-connected cells, in the order of their
    targets.

    Returns:
        Flat index of the source cells, of the target cells, and the length of each edge
        in cell widths (1 or √2), each of shape [E]. The arrays are shared: do not write
        to them.
    """
    index = np.arange(height * width).reshape(height, width)
    padded = np.pad(index, 1, constant_values=NO_CELL)
    # Of each cell the nine around it, row by row.
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(-1, 9)
    lengths = np.hypot(*(np.indices((3, 3)) - 1)).ravel()
    target, place = np.nonzero((around != NO_CELL) & (lengths > 0))
    return around[target, place], target, lengths[place]


def squeezes(
    free_of: Callable[[Cells], Mask], source: Cells, target: Cells, width: int
) -> Mask:
    """Tell which steps from a free cell to a free cell pass between two cells that are
    not free.

    Args:
        free_of: tells of cells, by flat index, whether they are free, bool.
        source: flat index of the cell that each step leaves, an array or a tensor.
        target: flat index of the cell that it enters, at most one row and one column
            away, of the same shape.
        width: W.

    Returns:
        bool, of the shape that `free_of` gives. No step over a shared edge is among
        them.
    """
    one, other = (
        source // width * width + target % width,
        target // width * width + source % width,
    )
    return free_of(source) & free_of(target) & ~free_of(one) & ~free_of(other)


def cost_to_go(
    edge_costs: Iterable[ndarray], goals: ndarray, shape: tuple[int, int]
) -> tuple[ndarray, ndarray]:
    """Finds the least cost from every cell to the nearest goal cell of its own map.

    Args:
        edge_costs: cost > 0 of each edge of `neighbour_pairs`, infinite where it may
            not be taken, shape [E] of each of B maps, one by one.
        goals: goal cells, bool, shape [B, H, W].
        shape: (H, W).

    Returns:
        Cost to go, infinite where no path leads to a goal, shape [B, H, W]; and the
        flat index of the next cell on a shortest path, `NO_CELL` at goals and where
        there is none, int64, shape [B, H·W].
    """
    batch, cells = len(goals), shape[0] * shape[1]
    # Searching backward from the goals, so the edges are turned round: rows are their
    # targets, their order.
    source, target, _ = neighbour_pairs(*shape)
    columns, rows = (
        source.astype(np.int32),
        np.searchsorted(target, np.arange(cells + 1)).astype(np.int32),
    )
    graph = csr_array((np.empty(len(source)), columns, rows), shape=(cells, cells))
    cost, following = np.empty((batch, cells)), np.empty((batch, cells), np.int64)
    # The finite limit keeps infinite edges from being taken.
    search = partial(
        dijkstra,
        graph,
        min_only=True,
        return_predecessors=True,
        limit=np.finfo(np.float64).max,
    )
    for b, (graph.data, starts) in enumerate(
        zip(edge_costs, goals.reshape(batch, cells), strict=True)
    ):
        cost[b], following[b], _ = search(indices=np.flatnonzero(starts))
    return cost.reshape(batch, *shape), np.where(following >= 0, following, NO_CELL)


def travel_time_costs(
    traversability: ndarray,
    free: ndarray,
    resolution_m: float,
    closed_corners: bool = True,
) -> ndarray:
    """Gives the time each edge takes at a commanded 1 m/s, each half at its own cell's
    speed.

    Args:
        traversability: share of the commanded speed, shape [B, H, W].
        free: cells that may be entered, bool, shape [B, H, W].
        resolution_m: cell width in metres.
        closed_corners: whether `squeezes` are closed, as they are since version 1.2.

    Returns:
        Seconds, infinite at an edge with an end that is not free or that squeezes
        between two, shape [B, E].
    """
    batch, height, width = traversability.shape
    source, target, length = neighbour_pairs(height, width)
    pace = np.full((batch, height * width), np.inf)
    np.divide(
        1.0, traversability.reshape(batch, -1), out=pace, where=free.reshape(batch, -1)
    )
    costs = (
        0.5
        * length
        * resolution_m
        * (np.take(pace, source, axis=1) + np.take(pace, target, axis=1))
    )
    if closed_corners:
        open_ = partial(np.take, free.reshape(batch, -1), axis=1)
        costs[squeezes(open_, source, target, width)] = np.inf
    return costs
