"""How ground is cut into maps, and which of them belong to which split.

Maps are cut from the ground's south-west corner on, a stride apart, and are numbered
row by row, northward, each row eastward. Splits take strips across the longer side of
the ground, one each, in the order given. Between two strips lies ground of at least a
map's width that no map shows, so that maps of different splits neither overlap nor
touch.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from benchnav.core.errors import DatasetError, expect

Shape = tuple[int, int]  # along y and along x

SLACK = 1e-3  # of a cell, which arithmetic may be off by


class Run(NamedTuple):
    """Neighbouring maps of one split: their row of maps, and which of the row."""

    split: str
    row: int
    columns: range


class Tiling(NamedTuple):
    """Rows and columns of maps.

    Args:
        shape: cells of a map, (H, W).
        stride: cells from one map to the next, northward and eastward.
        tiles: rows and columns of maps.
        strips: by split the rows of maps that it takes, or the columns where there are
            as many or more.
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
        """Whether neighbouring maps show some of the same ground."""
        return bool(np.less(self.stride, self.shape).any())

    def groups(self, numbers: Sequence[int]) -> np.ndarray:
        """Finds which maps overlap, directly or by others between them.

        Args:
            numbers: of some maps, as they are numbered in the ground.

        Returns:
            For each the least number of a map of its group, int64, shape of `numbers`.
        """
        # A map is drawn on every second place of a lattice as a block that reaches to
        # the last map that it overlaps. So blocks share a place just where maps
        # overlap, and never touch where they do not.
        reach = 2 * np.ceil(np.divide(self.shape, self.stride)).astype(int) - 2
        own = np.asarray(numbers, dtype=np.int64)
        corners = tuple(2 * place for place in np.divmod(own, self.tiles[1]))
        drawn = np.zeros(2 * np.array(self.tiles) + reach, dtype=np.uint8)
        drawn[corners] = 1
        drawn = ndimage.maximum_filter(
            drawn, (reach + 1).tolist(), origin=(reach // 2).tolist(), mode="constant"
        )
        parts = ndimage.label(drawn)[0][corners]
        _, firsts, inverse = np.unique(parts, return_index=True, return_inverse=True)
        return own[firsts][inverse]

    def split_of(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Which split's maps show cells: index into `strips`, −1 where none do, int64,
        shape of `row`.

        Args:
            row: of the cells, counted northward.
            column: counted eastward.
        """
        rows, columns = self.tiles
        side = 0 if rows > columns else 1
        along, split = (row, column)[side], np.full(np.shape(row), -1)
        for place, strip in enumerate(self.strips.values()):
            first, last = (
                strip.start * self.stride[side],
                (strip.stop - 1) * self.stride[side] + self.shape[side],
            )
            split[(along >= first) & (along < last)] = place
        for cell, count, stride, size in zip(
            (row, column), self.cells, self.stride, self.shape, strict=True
        ):
            split[(cell < 0) | (cell >= count) | (cell % stride >= size)] = -1
        return split

    @property
    def between(self) -> int:
        """Number of maps that would lie between the splits, which belong to none."""
        return self.tiles[0] * self.tiles[1] - self.maps

    def runs(self, most: int) -> Iterator[Run]:
        """Goes through all maps, row by row, at most so many at a time."""
        rows, columns = self.tiles
        for row in range(rows):
            for split, strip in self.strips.items():
                own = (
                    strip if rows <= columns else range(columns if row in strip else 0)
                )
                for first in range(own.start, own.stop, most):
                    yield Run(split, row, range(first, min(first + most, own.stop)))


def cut(
    cells: Sequence[int], shape: Shape, stride: Shape, shares: Mapping[str, float]
) -> Tiling:
    """Cuts ground into maps and splits.

    Args:
        cells: of the ground, northward and eastward, of at least one map.
        shape: cells of a map, (H, W).
        stride: cells from one map to the next, northward and eastward.
        shares: of the maps, by split.

    Raises:
        DatasetError: the ground is too small for so many splits.
    """
    rows, columns = (np.subtract(cells, shape) // stride + 1).tolist()
    side, lines = (0, rows) if rows > columns else (1, columns)
    gap = _gap(shape, stride, side)
    usable = lines - gap * (len(shares) - 1)
    if usable < len(shares):
        raise DatasetError(
            f"Expected ground for {len(shares)} splits with a map's width between "
            f"them, got {lines} maps along its "
            "longer side. Take fewer splits, smaller maps or larger ground."
        )
    ends = [0]
    for place, total in enumerate(accumulate(shares.values()), start=1):
        # Every split gets a strip, however small its share.
        ends.append(
            min(max(round(total * usable), ends[-1] + 1), usable - len(shares) + place)
        )
    strips = {
        split: range(ends[place] + place * gap, ends[place + 1] + place * gap)
        for place, split in enumerate(shares)
    }
    return Tiling(shape, stride, (rows, columns), strips)


def fewest_cells(shape: Shape, stride: Shape, splits: int) -> list[Shape]:
    """Return the cells of the smallest grounds for some splits, northward and eastward,
    each way that strips can lie.

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
    """Return the maps between two splits that belong to none, along a side."""
    return math.ceil(2 * shape[side] / stride[side]) - 1


def cut_around(
    places_m: np.ndarray,
    whole_m: np.ndarray,
    cell_m: np.ndarray,
    shape_m: np.ndarray,
    stride_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Cuts ground of whole maps around places, from an edge between cells of the raster
    on, where there is room.

    Args:
        places_m: northward and eastward from the raster's south-west corner, shape [N,
            2].
        whole_m: size of the raster; as what follows northward and eastward, shape [2].
        cell_m: size of its cells.
        shape_m: size of a map.
        stride_m: from one map to the next.

    Returns:
        South-west corner and size of the ground, each of shape [2].
    """
    low_m = np.maximum(places_m.min(axis=0) - cell_m, 0)
    high_m = np.minimum(places_m.max(axis=0) + cell_m, whole_m)
    more = np.maximum(np.ceil((high_m - low_m - shape_m) / stride_m - SLACK), 0)
    size_m = np.minimum(shape_m + more * stride_m, whole_m)
    edge_m = np.clip((low_m + high_m - size_m) / 2, 0, whole_m - size_m)
    return np.floor(edge_m / cell_m + SLACK) * cell_m, size_m


def read_shares(text: str) -> dict[str, float]:
    """Reads splits and their shares of the maps, such as
    `train:0.7,valid:0.1,test/site:0.2`.

    Raises:
        ConfigError: it is not of that form, or the shares do not sum to 1.
    """
    shares: dict[str, float] = {}
    for part in text.split(","):
        name, _, share = part.strip().partition(":")
        try:
            value = float(share or 1)
        except ValueError:
            value = math.nan
        expect(
            name and name not in shares and 0 < value <= 1,
            "`splits` such as train:0.7,valid:0.1,test/site:0.2, each name once and "
            "each share above 0, "
            f"got {part.strip()!r} in {text!r}.",
        )
        shares[name] = value
    total = sum(shares.values())
    expect(
        abs(total - 1) < 1e-6,
        f"the shares of `splits` to sum to 1, got {total:g} in {text!r}.",
    )
    return shares
