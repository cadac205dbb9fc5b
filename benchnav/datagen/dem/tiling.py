"""Tiling of terrain into maps, and assignment of maps to splits.

Maps are cut from the south-west corner of the terrain, a stride apart. Their indices
increase eastward within a row of maps, and from row to row northward. Each split gets
one strip across the longer side of the terrain, in the order of the splits. Between two
strips, terrain of at least a map's width is on no map. Maps of different splits
therefore neither overlap nor touch.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from benchnav.core.errors import DatasetError, expect

Shape = tuple[int, int]  # numbers of cells or maps along y and along x

SLACK = 1e-3  # tolerance of positions, in cells


class Run(NamedTuple):
    """Neighbouring maps of one split.

    Args:
        split: name of the split.
        row: index of the row of maps.
        columns: indices of the maps in this row.
    """

    split: str
    row: int
    columns: range


class Tiling(NamedTuple):
    """Rows and columns of maps.

    Args:
        shape: cells of a map, (H, W).
        stride: cells from one map to the next, northward and eastward.
        tiles: numbers of rows and columns of maps.
        strips: range of rows of maps by split; if there are no more rows than columns,
            range of columns of maps.
    """

    shape: Shape
    stride: Shape
    tiles: Shape
    strips: Mapping[str, range]

    @property
    def cells(self) -> list[int]:
        """Number of cells that the maps cover together, northward and eastward."""
        last_map = np.subtract(self.tiles, 1) * self.stride
        return (last_map + self.shape).tolist()

    @property
    def maps(self) -> int:
        """Number of maps of all splits."""
        n_lines = sum(len(strip) for strip in self.strips.values())
        return n_lines * min(self.tiles)

    @property
    def overlaps(self) -> bool:
        """Whether neighbouring maps overlap."""
        return bool(np.less(self.stride, self.shape).any())

    def groups(self, map_indices: Sequence[int]) -> np.ndarray:
        """Return each map's group: maps that overlap directly or through other maps.

        Args:
            map_indices: indices of the maps in the terrain.

        Returns:
            Lowest map index in each map's group, int64, shape of `map_indices`.
        """
        # On a lattice with two points per stride, each map is a block that extends to
        # the last map that it overlaps. Two blocks intersect if and only if the maps
        # overlap; otherwise, they do not touch.
        n_strides = np.ceil(np.divide(self.shape, self.stride)).astype(int)
        reach = 2 * n_strides - 2
        indices = np.asarray(map_indices, dtype=np.int64)
        row, column = np.divmod(indices, self.tiles[1])
        corners = (2 * row, 2 * column)
        lattice = np.zeros(2 * np.array(self.tiles) + reach, dtype=np.uint8)
        lattice[corners] = 1
        size = (reach + 1).tolist()
        origin = (reach // 2).tolist()
        blocks = ndimage.maximum_filter(lattice, size, origin=origin, mode="constant")
        labelled, _ = ndimage.label(blocks)
        labels = labelled[corners]
        _, firsts, inverse = np.unique(labels, return_index=True, return_inverse=True)
        return indices[firsts][inverse]

    def split_of(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return the index of the split whose maps contain each cell.

        Args:
            row: row of each cell, counted northward.
            column: column of each cell, counted eastward.

        Returns:
            Index into `strips`, −1 for cells in no map, int64, shape of `row`.
        """
        rows, columns = self.tiles
        side = 0 if rows > columns else 1
        along = (row, column)[side]
        stride = self.stride[side]
        split = np.full(np.shape(row), -1)
        for index, strip in enumerate(self.strips.values()):
            first = strip.start * stride
            stop = (strip.stop - 1) * stride + self.shape[side]
            split[(along >= first) & (along < stop)] = index
        for side, cell in enumerate((row, column)):
            is_off = (cell < 0) | (cell >= self.cells[side])
            is_between = cell % self.stride[side] >= self.shape[side]
            split[is_off | is_between] = -1
        return split

    @property
    def n_omitted(self) -> int:
        """Number of omitted maps between the splits."""
        return self.tiles[0] * self.tiles[1] - self.maps

    def runs(self, max_maps: int) -> Iterator[Run]:
        """Yield all maps row by row, in runs of up to `max_maps`."""
        rows, columns = self.tiles
        for row in range(rows):
            for split, strip in self.strips.items():
                indices = strip
                if rows > columns:
                    indices = range(columns if row in strip else 0)
                for first in range(indices.start, indices.stop, max_maps):
                    stop = min(first + max_maps, indices.stop)
                    yield Run(split, row, range(first, stop))


def cut(
    cells: Sequence[int], shape: Shape, stride: Shape, shares: Mapping[str, float]
) -> Tiling:
    """Return the tiling of terrain into maps and splits.

    Args:
        cells: number of cells of the terrain, northward and eastward; at least `shape`.
        shape: cells of a map, (H, W).
        stride: cells from one map to the next, northward and eastward.
        shares: fraction of the maps of each split.

    Raises:
        DatasetError: If the terrain is too small for the number of splits.
    """
    rows, columns = (np.subtract(cells, shape) // stride + 1).tolist()
    side = 0 if rows > columns else 1
    n_lines = max(rows, columns)
    n_splits = len(shares)
    gap = _gap(shape, stride, side)
    usable = n_lines - gap * (n_splits - 1)
    if usable < n_splits:
        raise DatasetError(
            f"Expected terrain for {n_splits} splits with a map's width between "
            f"splits, got {n_lines} maps along the longer side of the terrain. Use "
            "fewer splits, smaller maps or larger terrain."
        )
    ends = [0]
    for count, total in enumerate(accumulate(shares.values()), start=1):
        # Each split gets at least one row or column of maps, even for a small fraction.
        min_end = ends[-1] + 1
        max_end = usable - n_splits + count
        end = max(round(total * usable), min_end)
        ends.append(min(end, max_end))
    strips = {}
    for index, split in enumerate(shares):
        offset = index * gap
        strips[split] = range(ends[index] + offset, ends[index + 1] + offset)
    return Tiling(shape, stride, (rows, columns), strips)


def fewest_cells(shape: Shape, stride: Shape, splits: int) -> list[Shape]:
    """Return the smallest sizes of terrain for a number of splits.

    The first size is for strips along y, the second for strips along x.

    Args:
        shape: cells of a map, (H, W).
        stride: cells from one map to the next, northward and eastward.
        splits: number of splits.
    """
    sizes = []
    for side in (0, 1):
        cells = list(shape)
        n_strides = (splits - 1) * (_gap(shape, stride, side) + 1)
        cells[side] += n_strides * stride[side]
        sizes.append((cells[0], cells[1]))
    return sizes


def _gap(shape: Shape, stride: Shape, side: int) -> int:
    """Return the number of omitted maps between splits along a side (0: y, 1: x)."""
    return math.ceil(2 * shape[side] / stride[side]) - 1


def cut_around(
    positions_m: np.ndarray,
    raster_m: np.ndarray,
    cell_m: np.ndarray,
    shape_m: np.ndarray,
    stride_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return a part of the terrain around positions, for an integer number of maps.

    If there is room, the part begins at an edge between cells of the raster. All pairs
    are northward and eastward, in metres.

    Args:
        positions_m: positions from the raster's south-west corner, shape [N, 2].
        raster_m: size of the raster, shape [2].
        cell_m: size of the raster's cells, shape [2].
        shape_m: size of a map, shape [2].
        stride_m: distance from one map to the next, shape [2].

    Returns:
        South-west corner and size of the part, each of shape [2].
    """
    low_m = np.maximum(positions_m.min(axis=0) - cell_m, 0)
    high_m = np.minimum(positions_m.max(axis=0) + cell_m, raster_m)
    strides = (high_m - low_m - shape_m) / stride_m
    n_strides = np.maximum(np.ceil(strides - SLACK), 0)
    size_m = np.minimum(shape_m + n_strides * stride_m, raster_m)
    centred_m = (low_m + high_m - size_m) / 2
    edge_m = np.clip(centred_m, 0, raster_m - size_m)
    corner_m = np.floor(edge_m / cell_m + SLACK) * cell_m
    return corner_m, size_m


def read_shares(text: str) -> dict[str, float]:
    """Return fractions by split from text: `train:0.7,valid:0.1,test/site:0.2`.

    Raises:
        ConfigError: If the text has another form, or the fractions do not sum to 1.
    """
    shares: dict[str, float] = {}
    for part in text.split(","):
        name, _, fraction = part.strip().partition(":")
        try:
            value = float(fraction or 1)
        except ValueError:
            value = math.nan
        expect(
            name and name not in shares and 0 < value <= 1,
            "`splits` such as train:0.7,valid:0.1,test/site:0.2, with each name once "
            f"and each fraction in (0, 1], got {part.strip()!r} in {text!r}.",
        )
        shares[name] = value
    total = sum(shares.values())
    expect(
        abs(total - 1) < 1e-6,
        f"the fractions of `splits` to sum to 1, got {total:g} in {text!r}.",
    )
    return shares
