"""Sums over cells in bins of slope: all that the class-wise GPs need to know of their data.

Many observations at one slope enter the likelihood by five sums. A bin of width w makes the noise seem
larger by |f'|·w/√12 in root mean square; at 0.25° and a fall of 5 % a degree, 0.004 beside noise of 0.1
or more, that is under 0.1 % of it. Sums of parts of the data add up, so that memory does not grow with
them. A second mode of λ shows in no sum, so the cells are also counted by bins of λ. Letters in shapes:
C classes, B bins of slope, V = 258 bins of λ: that at 0, 256 inside (0, 1), that at 1.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from benchnav.core.errors import DatasetError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.slope_gp.cells import Cells, read_cells

BIN_DEG = 0.25
INSIDE_BINS = 256

_BINS = round(90 / BIN_DEG) + 1
_VALUES = INSIDE_BINS + 2


@dataclass(frozen=True, kw_only=True)
class SlopeSums:
    """What is kept of observed cells.

    Args:
        cells: counts by class, bin of slope and bin of λ, int64, shape [C, B, V].
        slope: sum of the slopes, float64, shape [C, B].
        total: sum of λ over the cells inside (0, 1), float64, shape [C, B].
        squares: sum of λ² over those, float64, shape [C, B].
        steepest_deg: steepest slope of each class, 0 for one without cells, float32, shape [C].
    """

    cells: Tensor
    slope: Tensor
    total: Tensor
    squares: Tensor
    steepest_deg: Tensor

    @classmethod
    def of(cls, cells: Cells, class_count: int) -> "SlopeSums":
        """Sums cells up.

        Args:
            cells: of classes under C.
            class_count: C.
        """
        slope, value = cells.slope_deg.double(), cells.traversability.double()
        place = cells.class_id * _BINS + (slope / BIN_DEG).long()
        inside = (value > 0) & (value < 1)
        level = torch.where(inside, (value * INSIDE_BINS).long() + 1, (value > 0) * (_VALUES - 1))
        steepest = torch.zeros(class_count).scatter_reduce(0, cells.class_id, cells.slope_deg.float(), "amax")

        def add(weights: Tensor) -> Tensor:
            return torch.bincount(place, weights, class_count * _BINS).view(class_count, _BINS)

        counted = torch.bincount(place * _VALUES + level, minlength=class_count * _BINS * _VALUES)
        return cls(
            cells=counted.view(class_count, _BINS, _VALUES),
            slope=add(slope),
            total=add(inside * value),
            squares=add(inside * value**2),
            steepest_deg=steepest,
        )

    def __add__(self, other: "SlopeSums") -> "SlopeSums":
        """The sums over both parts of the data."""
        return SlopeSums(
            cells=self.cells + other.cells,
            slope=self.slope + other.slope,
            total=self.total + other.total,
            squares=self.squares + other.squares,
            steepest_deg=torch.maximum(self.steepest_deg, other.steepest_deg),
        )

    @property
    def count(self) -> Tensor:
        """Cells of each class, int64, shape [C]."""
        return self.cells.sum((1, 2))

    def bins(self, censored: bool) -> dict[str, Tensor]:
        """Gives the sums that the likelihood takes, up to the steepest bin with cells.

        Args:
            censored: whether λ of 0 and 1 was clipped there; otherwise it counts as any other.

        Returns:
            `slope_deg` (mean of a bin's slopes), `zeros` and `ones` (cells clipped at 0 and 1), `inside`
            (all others), `total` and `squares` (sum of λ and λ² over those), float64, each of shape
            [C, B]; and `count`, the cells of each class in all, shape [C].
        """
        cells = self.cells.sum(2).double()
        size = int((cells.sum(0) > 0).nonzero().max()) + 1 if bool(cells.any()) else 1
        zeros, ones = self.cells[..., 0].double(), self.cells[..., -1].double()
        middle = (torch.arange(_BINS, dtype=torch.float64) + 0.5) * BIN_DEG
        sums = {
            "slope_deg": torch.where(cells > 0, self.slope / cells.clamp(min=1), middle),
            "zeros": zeros if censored else 0 * zeros,
            "ones": ones if censored else 0 * ones,
            "inside": cells - zeros - ones if censored else cells,
            "total": self.total if censored else self.total + ones,
            "squares": self.squares if censored else self.squares + ones,
        }
        return {**{name: values[:, :size].clone() for name, values in sums.items()}, "count": self.count}


def levels() -> Tensor:
    """λ of the bins, 0 and 1 at the ends and the middles of those inside, float64, shape [V]."""
    inside = (torch.arange(INSIDE_BINS, dtype=torch.float64) + 0.5) / INSIDE_BINS
    return torch.cat([torch.zeros(1), inside, torch.ones(1)])


def sum_cells(parts: Iterable[Cells], class_count: int) -> SlopeSums:
    """Sums parts of the data up, one after the other.

    Args:
        parts: one or more.
        class_count: C.
    """
    return reduce(SlopeSums.__add__, (SlopeSums.of(cells, class_count) for cells in parts))


def sum_split(dataset: TerrainDataset, split: str) -> SlopeSums:
    """Sums all observed cells of a split up, read some maps at a time.

    Raises:
        DatasetError: there is no such split, or nothing was observed in it.
    """
    sums = sum_cells(read_cells(dataset, split), len(dataset.recipe.classes))
    if not int(sums.count.sum()):
        raise DatasetError(
            f"Expected observed traversability in split {split!r} of {dataset.path}, got NaN in every cell. "
            "Train on maps that a robot has driven over."
        )
    return sums
