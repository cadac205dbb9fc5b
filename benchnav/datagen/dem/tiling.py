"""Tiling of terrain into maps, and assignment of maps to splits.

Maps are cut from the south-west corner of the terrain, a stride apart. Their indices
run row by row, northward, and eastward within a row. Each split gets one strip across
the longer side of the terrain, in the order of the splits. Between two strips, terrain
of at least a map's width is in no map. Maps of different splits therefore neither
overlap nor touch.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from benchnav.core.errors import DatasetError, expect

Shape = tuple[int, int]  # along y and along x

SLACK = 1e-3  # tolerance of positions, in cells


class Run(NamedTuple):
    """Neighbouring maps of one split.

    Args:
        split: name of the split.
        row: their row of maps.
        columns: their indices in the row.
    """

    split: str
    row: int
    columns: range


class Tiling(NamedTuple):
    """Rows and columns of maps.

    Args:
        shape: cells of a map, (H, W).
        stride: cells from one map to the next, northward and eastward.
        tiles: rows and columns of maps.
        strips: rows of maps of each split if there are more rows than columns; else
            columns.
    """

    shape: Shape
    stride: Shape
    tiles: Shape
    strips: Mapping[str, range]

    @property
    def cells(self) -> list[int]:
        """Cells of all maps together, northward and eastward."""
        return (np.subtract(self.tiles, 1) * self.stride + self.shape).tolist()

    @property
    def maps(self) -> int:
        """Number of maps of all splits."""
        return sum(len(strip) for strip in self.strips.values()) * min(self.tiles)

    @property
    def overlaps(self) -> bool:
        """Whether neighbouring maps overlap."""
        return bool(np.less(self.stride, self.shape).any())

    def groups(self, numbers: Sequence[int]) -> np.ndarray:
        """Return groups of maps that overlap, directly or through other maps.

        Args:
            numbers: indices of some maps in the terrain.

        Returns:
            The lowest index of a map of each map's group, int64, shape of `numbers`.
        """
        # On a lattice of twice the resolution, draw each map as a block up to the last
        # map that it overlaps. Blocks intersect exactly if maps overlap, and do not
        # touch otherwise.
        reach = 2 * np.ceil(np.divide(self.shape, self.stride)).astype(int) - 2
        indices = np.asarray(numbers, dtype=np.int64)
        corners = tuple(2 * index for index in np.divmod(indices, self.tiles[1]))
        drawn = np.zeros(2 * np.array(self.tiles) + reach, dtype=np.uint8)
        drawn[corners] = 1
        drawn = ndimage.maximum_filter(
            drawn, (reach + 1).tolist(), origin=(reach // 2).tolist(), mode="constant"
        )
        labels = ndimage.label(drawn)[0][corners]
        _, firsts, inverse = np.unique(labels, return_index=True, return_inverse=True)
        return indices[firsts][inverse]

    def split_of(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return the split whose maps contain each cell.

        Args:
            row: rows of the cells, counted northward.
            column: columns of the cells, counted eastward.

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
        for cell, count, stride, size in zip(
            (row, column), self.cells, self.stride, self.shape, strict=True
        ):
            split[(cell < 0) | (cell >= count) | (cell % stride >= size)] = -1
        return split

    @property
    def between(self) -> int:
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
        cells: cells of the terrain, northward and eastward; at least one map.
        shape: cells of a map, (H, W).
        stride: cells from one map to the next, northward and eastward.
        shares: fraction of the maps of each split.

    Raises:
        DatasetError: If the terrain is too small for the number of splits.
    """
    rows, columns = (np.subtract(cells, shape) // stride + 1).tolist()
    side, lines = (0, rows) if rows > columns else (1, columns)
    gap = _gap(shape, stride, side)
    usable = lines - gap * (len(shares) - 1)
    if usable < len(shares):
        raise DatasetError(
            f"Expected ground for {len(shares)} splits with a map's width between "
            f"them, got {lines} maps along its longer side. Take fewer splits, smaller "
            "maps or larger ground."
        )
    ends = [0]
    for count, total in enumerate(accumulate(shares.values()), start=1):
        # Each split gets a strip, even for a small fraction.
        end = max(round(total * usable), ends[-1] + 1)
        ends.append(min(end, usable - len(shares) + count))
    strips = {}
    for index, split in enumerate(shares):
        offset = index * gap
        strips[split] = range(ends[index] + offset, ends[index + 1] + offset)
    return Tiling(shape, stride, (rows, columns), strips)


def fewest_cells(shape: Shape, stride: Shape, splits: int) -> list[Shape]:
    """Return the smallest sizes of terrain for some splits, for both strip directions.

    Args:
        shape: cells of a map, (H, W).
        stride: cells from one map to the next, northward and eastward.
        splits: number of splits.
    """
    grounds = []
    for side in (0, 1):
        cells = list(shape)
        cells[side] += (splits - 1) * (_gap(shape, stride, side) + 1) * stride[side]
        grounds.append((cells[0], cells[1]))
    return grounds


def _gap(shape: Shape, stride: Shape, side: int) -> int:
    """Return the number of omitted maps between two splits, along a side."""
    return math.ceil(2 * shape[side] / stride[side]) - 1


def cut_around(
    positions_m: np.ndarray,
    raster_m: np.ndarray,
    cell_m: np.ndarray,
    shape_m: np.ndarray,
    stride_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return terrain around positions that fits an integer number of maps.

    If there is room, it begins at an edge between cells of the raster. All pairs are
    northward and eastward, in metres.

    Args:
        positions_m: positions from the raster's south-west corner, shape [N, 2].
        raster_m: size of the raster, shape [2].
        cell_m: size of its cells, shape [2].
        shape_m: size of a map, shape [2].
        stride_m: distance from one map to the next, shape [2].

    Returns:
        South-west corner and size of the terrain, each of shape [2].
    """
    low_m = np.maximum(positions_m.min(axis=0) - cell_m, 0)
    high_m = np.minimum(positions_m.max(axis=0) + cell_m, raster_m)
    n_strides = np.maximum(np.ceil((high_m - low_m - shape_m) / stride_m - SLACK), 0)
    size_m = np.minimum(shape_m + n_strides * stride_m, raster_m)
    edge_m = np.clip((low_m + high_m - size_m) / 2, 0, raster_m - size_m)
    return np.floor(edge_m / cell_m + SLACK) * cell_m, size_m


def read_shares(text: str) -> dict[str, float]:
    """Return splits and fractions from text: `train:0.7,valid:0.1,test/site:0.2`.

    Raises:
        ConfigError: If it has another form, or the fractions do not sum to 1.
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
            "`splits` such as train:0.7,valid:0.1,test/site:0.2, each name once and "
            f"each share above 0, got {part.strip()!r} in {text!r}.",
        )
        shares[name] = value
    total = sum(shares.values())
    expect(
        abs(total - 1) < 1e-6,
        f"the shares of `splits` to sum to 1, got {total:g} in {text!r}.",
    )
    return shares
