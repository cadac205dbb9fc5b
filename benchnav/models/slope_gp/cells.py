"""Cells that a robot has driven over, from maps or from slip logs (`slip_logs`): what
the class-wise GPs learn from.

Cells whose slope or traversability was not observed (NaN), or whose class is not known,
are left out. Many observations at one slope enter the likelihood of the GPs by five
sums. A bin of width w makes the noise seem larger by
|f'|·w/√12 in root mean square; at 0.25° and a fall of 5 % a degree, 0.004 beside noise of 0.1 or more, that is under
0.1 % of it. Sums of parts of the data add up, so that memory does not grow with them. A
second mode of λ shows in no sum, so the cells are also counted by bins of λ. Letters in
shapes: N cells, C classes, B bins of slope, V = 258 bins of
λ: that at 0, 256 inside (0, 1), that at 1.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import map_tensors
from benchnav.core.errors import DatasetError
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.slope_gp.table import SlopeTable

CHUNK_CELLS = 2**18
BIN_DEG = 0.25
INSIDE_BINS = 256
_BINS = round(90 / BIN_DEG) + 1
_VALUES = INSIDE_BINS + 2


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Observed cells; `observed_cells` makes them of columns with gaps.

    Args:
        class_id: int64, shape [N].
        slope_deg: in [0, 90], shape [N].
        traversability: observed λ in [0, 1], shape [N].
    """

    class_id: Tensor
    slope_deg: Tensor
    traversability: Tensor

    def __len__(self) -> int:
        """Number of cells N."""
        return len(self.class_id)

    def select(self, which: Tensor) -> "Cells":
        """Keeps some cells, by index or by truth, shape [M]."""
        return map_tensors(self, lambda values: values[which])


def observed_cells(
    class_id: Tensor, slope_deg: Tensor, traversability: Tensor
) -> Cells:
    """Takes out the cells whose slope and traversability were observed and whose class
    is known.

    Args:
        class_id: integers in [0, C), 255 where not known, any shape.
        slope_deg: slopes in [0, 90], NaN where not observed, shape of `class_id`.
        traversability: λ in [0, 1], NaN where not observed, shape of `class_id`.
    """
    ids, slopes, values = (
        column.flatten() for column in (class_id, slope_deg, traversability)
    )
    seen = ~(slopes.isnan() | values.isnan()) & (ids != UNLABELLED)
    return Cells(
        class_id=ids[seen].long(), slope_deg=slopes[seen], traversability=values[seen]
    )


def read_cells(
    dataset: TerrainDataset, split: str, chunk_cells: int = CHUNK_CELLS
) -> Iterator[Cells]:
    """Reads the observed cells of a split, some maps at a time.

    Args:
        dataset: where they are.
        split: name of a split.
        chunk_cells: most cells to hold at once, but at least one map.

    Raises:
        DatasetError: there is no such split.
    """
    names = ("class_id", "slope_deg", "traversability")
    for _, maps in dataset.chunks(split, names, chunk_cells):
        yield observed_cells(*(torch.from_numpy(maps[name]) for name in names))


def hold_out(cells: Cells, share: float, seed: int = 0) -> tuple[Cells, Cells]:
    """Splits cells class by class: those held out follow one another, from a place that
    is drawn.

    Rows that a robot logs one after the other are alike, so that single rows drawn from
    among them would tell how well neighbours are known rather than the ground of
    another drive.

    Args:
        cells: of any classes, in the order in which they were driven over.
        share: of each class's cells to hold out, in (0, 1); rounded down, so that one
            cell is kept.
        seed: root seed of the draw.

    Returns:
        The cells to learn from, and those held out.
    """
    counts = cells.class_id.bincount(minlength=1)
    out = (counts * share).long()
    key = rng.stream_key(seed, "models", "held-out cells")
    held = torch.zeros(len(cells), dtype=torch.bool)
    drawn = rng.uniform(key, np.arange(len(counts)))
    for c, (count, few) in enumerate(zip(counts.tolist(), out.tolist(), strict=True)):
        first = int(drawn[c] * (count - few + 1))
        held[(cells.class_id == c).nonzero().flatten()[first : first + few]] = True
    return cells.select(~held), cells.select(held)


def hold_out_drives(drive: Tensor, share: float, seed: int = 0) -> Tensor:
    """Chooses whole drives to hold out, in an order that is drawn, so that their rows
    come near a share of all.

    Args:
        drive: number of each row's drive, int64, shape [N], of two drives at least.
        share: of the rows to hold out, in (0, 1).
        seed: root seed of the draw.

    Returns:
        Which rows are held out, of one drive at least and never of all, bool, shape
        [N].
    """
    rows = drive.bincount().tolist()
    order = rng.permutation(
        rng.stream_key(seed, "models", "held-out drives"), np.arange(1), len(rows)
    )[0]
    chosen: list[int] = []
    wanted = share * len(drive)
    for one in order.tolist():
        held = sum(rows[other] for other in chosen)
        if abs(held + rows[one] - wanted) < abs(held - wanted):
            chosen.append(one)
    # All are longer than twice the share: then the shortest.
    chosen = chosen[: len(rows) - 1] or [min(order.tolist(), key=rows.__getitem__)]
    return torch.isin(drive, torch.tensor(chosen))


@dataclass(frozen=True, kw_only=True)
class SlopeSums:
    """What is kept of observed cells.

    Args:
        cells: counts by class, bin of slope and bin of λ, int64, shape [C, B, V].
        slope: sum of the slopes, float64, shape [C, B].
        total: sum of λ over the cells inside (0, 1), float64, shape [C, B].
        squares: sum of λ² over those, float64, shape [C, B].
        steepest_deg: steepest slope of each class, 0 for one without cells, float32,
            shape [C].
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
        level = torch.where(
            inside, (value * INSIDE_BINS).long() + 1, (value > 0) * (_VALUES - 1)
        )
        steepest = torch.zeros(class_count).scatter_reduce(
            0, cells.class_id, cells.slope_deg.float(), "amax"
        )

        def add(weights: Tensor) -> Tensor:
            return torch.bincount(place, weights, class_count * _BINS).view(
                class_count, _BINS
            )

        counted = torch.bincount(
            place * _VALUES + level, minlength=class_count * _BINS * _VALUES
        )
        return cls(
            cells=counted.view(class_count, _BINS, _VALUES),
            slope=add(slope),
            total=add(inside * value),
            squares=add(inside * value**2),
            steepest_deg=steepest,
        )

    def __add__(self, other: "SlopeSums") -> "SlopeSums":
        """The sums over both parts of the data."""
        added = {name: sums + getattr(other, name) for name, sums in vars(self).items()}
        steepest = torch.maximum(self.steepest_deg, other.steepest_deg)
        return SlopeSums(**{**added, "steepest_deg": steepest})

    @property
    def count(self) -> Tensor:
        """Cells of each class, int64, shape [C]."""
        return self.cells.sum((1, 2))

    def bins(self, censored: bool) -> dict[str, Tensor]:
        """Gives the sums that the likelihood takes, up to the steepest bin with cells.

        Args:
            censored: whether λ of 0 and 1 was clipped there; otherwise it counts as any
                other.

        Returns:
            `slope_deg` (mean of a bin's slopes), `zeros` and `ones` (cells clipped at 0
            and 1), `inside` (all others), `total` and `squares` (sum of λ and λ² over
            those), float64, each of shape [C, B]; and `count`, the cells of each class
            in all, shape [C].
        """
        cells = self.cells.sum(2).double()
        size = max([0, *cells.sum(0).nonzero().flatten().tolist()]) + 1
        at_0, at_1 = self.cells[..., 0].double(), self.cells[..., -1].double()
        zeros, ones = at_0 * censored, at_1 * censored
        middle = (torch.arange(_BINS, dtype=torch.float64) + 0.5) * BIN_DEG
        sums = {
            "slope_deg": torch.where(
                cells > 0, self.slope / cells.clamp(min=1), middle
            ),
            "zeros": zeros,
            "ones": ones,
            "inside": cells - zeros - ones,
            "total": self.total + (at_1 - ones),
            "squares": self.squares + (at_1 - ones),
        }
        return {
            **{name: values[:, :size].clone() for name, values in sums.items()},
            "count": self.count,
        }


def levels() -> Tensor:
    """λ of the bins, 0 and 1 at the ends and the middles of those inside, float64,
    shape [V].
    """
    inside = (torch.arange(INSIDE_BINS, dtype=torch.float64) + 0.5) / INSIDE_BINS
    return torch.cat([torch.zeros(1), inside, torch.ones(1)])


def sum_cells(parts: Iterable[Cells], class_count: int) -> SlopeSums:
    """Sums parts of the data up, one after the other.

    Args:
        parts: one or more.
        class_count: C.
    """
    return reduce(
        SlopeSums.__add__, (SlopeSums.of(cells, class_count) for cells in parts)
    )


def sum_split(dataset: TerrainDataset, split: str) -> SlopeSums:
    """Sums all observed cells of a split up, read some maps at a time.

    Raises:
        DatasetError: there is no such split, or nothing was observed in it.
    """
    sums = sum_cells(read_cells(dataset, split), len(dataset.recipe.classes))
    if not int(sums.count.sum()):
        raise DatasetError(
            f"Expected observed traversability in split {split!r} of {dataset.path}, "
            "got NaN in every cell. "
            "Train on maps that a robot has driven over."
        )
    return sums


def cell_nll(cells: Cells, table: SlopeTable) -> float:
    """Mean negative log likelihood of cells, each read with its own class.

    Args:
        cells: of the classes of the table.
        table: the GPs.

    Returns:
        The mean over all cells: of the log density inside (0, 1), of the log mass at 0
            and 1.
    """
    mixture = table.own(cells.class_id.view(1, 1, -1), cells.slope_deg.view(1, 1, -1))
    return -float(mixture.log_prob(cells.traversability.view(1, 1, -1)).double().mean())


def measure_latent(
    table: SlopeTable, chunks: Iterable[Terrain], truth: bool = True
) -> dict[str, float]:
    """Measures the GPs apart from the classifier, each cell that has a class read with
    it.

    Args:
        table: the GPs over slope.
        chunks: the maps, at least one, a few at a time.
        truth: whether the maps' true distribution of λ is known.

    Returns:
        `nll` of λ as realised and, where the truth is known, `latent_rmse` to f_c(ψ)
        and `noise_error` (largest relative error of a class's σ_c that occurs).
    """
    squares, cells, surprise, seen, noise_error = 0.0, 0, 0.0, 0, 0.0
    for terrain in chunks:
        labelled = terrain.class_id != UNLABELLED
        layers = (terrain.class_id, terrain.slope_deg, terrain.traversability)
        class_id, slope_deg, observed = (
            layer[labelled].unsqueeze(0) for layer in layers
        )
        own, true = table.own(class_id, slope_deg), terrain.truth.at(labelled)
        known = ~observed.isnan()
        surprise -= float(own.log_prob(observed)[known].double().sum())
        seen += int(known.sum())
        squares += float((own.means[0] - true.means[0]).double().square().sum())
        cells += class_id.numel()
        if class_id.numel():
            ratio = table.noise_std[class_id] / true.stds[0]
            noise_error = max(noise_error, float((ratio - 1).abs().max()))
    errors = (
        {"latent_rmse": (squares / max(1, cells)) ** 0.5, "noise_error": noise_error}
        if truth
        else {}
    )
    return {**errors, "nll": surprise / max(1, seen)}
