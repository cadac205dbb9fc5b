"""Training cells of the class-wise GPs, from maps or from slip logs (`slip_logs`).

Cells whose slope or traversability is missing (NaN), and unlabelled cells, are left
out. Five sums per slope bin summarise the cells for the likelihood of the GPs. If f is
the GP's function, a bin of width w adds noise of root mean square |f'|·w/√12. For w =
0.25° and |f'| = 0.05 per degree this is 0.004, which increases noise of at least 0.1 by
less than 0.1 %. The sums of parts of the data are added, so memory does not grow with
the data. The sums do not show a second mode of λ, so the cells are also counted by bins
of λ. Letters in shapes: N cells, C classes, B bins of slope, V = 258 bins of λ: the atom
at 0, 256 bins in (0, 1), the atom at 1.
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
_N_SLOPE_BINS = round(90 / BIN_DEG) + 1
_N_LEVEL_BINS = INSIDE_BINS + 2
_LAYERS = ("class_id", "slope_deg", "traversability")


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Observed cells; `observed_cells` creates them from columns with missing values.

    Args:
        class_id: int64, shape [N].
        slope_deg: slopes in degrees, in [0, 90], shape [N].
        traversability: observed λ in [0, 1], shape [N].
    """

    class_id: Tensor
    slope_deg: Tensor
    traversability: Tensor

    def __len__(self) -> int:
        """Number of cells N."""
        return len(self.class_id)

    def select(self, selection: Tensor) -> "Cells":
        """Return the cells that indices or a mask select."""
        return map_tensors(self, lambda values: values[selection])


def observed_cells(
    class_id: Tensor, slope_deg: Tensor, traversability: Tensor
) -> Cells:
    """Return the labelled cells with observed slope and traversability.

    Args:
        class_id: integers in [0, C), 255 if unlabelled, any shape.
        slope_deg: slopes in [0, 90], NaN if not observed, shape of `class_id`.
        traversability: λ in [0, 1], NaN if not observed, shape of `class_id`.
    """
    class_ids = class_id.flatten()
    slopes = slope_deg.flatten()
    values = traversability.flatten()
    is_missing = slopes.isnan() | values.isnan()
    seen = ~is_missing & (class_ids != UNLABELLED)
    return Cells(
        class_id=class_ids[seen].long(),
        slope_deg=slopes[seen],
        traversability=values[seen],
    )


def read_cells(
    dataset: TerrainDataset, split: str, chunk_cells: int = CHUNK_CELLS
) -> Iterator[Cells]:
    """Read the observed cells of a split in chunks of maps.

    Args:
        dataset: dataset to read from.
        split: name of a split.
        chunk_cells: maximum number of cells in memory; a chunk has at least one map.

    Raises:
        DatasetError: If the split does not exist.
    """
    for _, maps in dataset.chunks(split, _LAYERS, chunk_cells):
        layers = (torch.from_numpy(maps[name]) for name in _LAYERS)
        yield observed_cells(*layers)


def hold_out(cells: Cells, fraction: float, seed: int = 0) -> tuple[Cells, Cells]:
    """Hold out consecutive cells of each class, from a random start.

    Consecutive rows of a log are correlated. Rows held out one by one at random would
    measure interpolation between neighbours instead of generalisation to another drive.

    Args:
        cells: cells of any classes, in driving order.
        fraction: fraction of each class's cells to hold out, in (0, 1). The number of
            cells is rounded down, so that at least one cell remains.
        seed: root seed of the random starts.

    Returns:
        The training cells and the held-out cells.
    """
    counts = cells.class_id.bincount(minlength=1)
    n_out = (counts * fraction).long()
    key = rng.stream_key(seed, "models", "held-out cells")
    held_out = torch.zeros(len(cells), dtype=torch.bool)
    uniform = rng.uniform(key, np.arange(len(counts)))
    sizes = zip(counts.tolist(), n_out.tolist(), strict=True)
    for class_id, (n_cells, n_held_out) in enumerate(sizes):
        start = int(uniform[class_id] * (n_cells - n_held_out + 1))
        indices = (cells.class_id == class_id).nonzero().flatten()
        held_out[indices[start : start + n_held_out]] = True
    return cells.select(~held_out), cells.select(held_out)


def hold_out_drives(drive: Tensor, fraction: float, seed: int = 0) -> Tensor:
    """Hold out random whole drives, with a number of rows close to a fraction of all rows.

    Args:
        drive: index of each row's drive, int64, shape [N]; at least two drives.
        fraction: fraction of the rows to hold out, in (0, 1).
        seed: root seed of the random choice.

    Returns:
        Mask of the held-out rows, bool, shape [N]: at least one drive, but not all.
    """
    n_rows = drive.bincount().tolist()
    key = rng.stream_key(seed, "models", "held-out drives")
    order = rng.permutation(key, np.arange(1), len(n_rows))[0].tolist()
    chosen: list[int] = []
    target_rows = fraction * len(drive)
    for index in order:
        n_held_out = sum(n_rows[i] for i in chosen)
        error = abs(n_held_out - target_rows)
        if abs(n_held_out + n_rows[index] - target_rows) < error:
            chosen.append(index)
    chosen = chosen[: len(n_rows) - 1]
    if not chosen:  # every drive has more than twice the rows wanted: use the shortest
        chosen = [min(order, key=n_rows.__getitem__)]
    return torch.isin(drive, torch.tensor(chosen))


@dataclass(frozen=True, kw_only=True)
class SlopeSums:
    """Counts and sums that summarise observed cells.

    Args:
        cells: number of cells by class, bin of slope and bin of λ, int64, [C, B, V].
        slope: sum of the slopes in degrees, float64, shape [C, B].
        total: sum of λ over the cells with λ in (0, 1), float64, shape [C, B].
        squares: sum of λ² over the cells with λ in (0, 1), float64, shape [C, B].
        steepest_deg: steepest slope of each class in degrees, 0 for a class without
            cells, float32, shape [C].
    """

    cells: Tensor
    slope: Tensor
    total: Tensor
    squares: Tensor
    steepest_deg: Tensor

    @classmethod
    def of(cls, cells: Cells, class_count: int) -> "SlopeSums":
        """Sum cells by class and bin.

        Args:
            cells: cells with class ids below C.
            class_count: C, number of classes.
        """
        slope = cells.slope_deg.double()
        value = cells.traversability.double()
        index = cells.class_id * _N_SLOPE_BINS + (slope / BIN_DEG).long()
        inside = (value > 0) & (value < 1)
        inside_level = (value * INSIDE_BINS).long() + 1
        level = torch.where(inside, inside_level, (value > 0) * (_N_LEVEL_BINS - 1))
        steepest = torch.zeros(class_count).scatter_reduce(
            0, cells.class_id, cells.slope_deg.float(), "amax"
        )
        n_bins = class_count * _N_SLOPE_BINS

        def add(weights: Tensor) -> Tensor:
            sums = torch.bincount(index, weights, n_bins)
            return sums.view(class_count, _N_SLOPE_BINS)

        counts = torch.bincount(
            index * _N_LEVEL_BINS + level, minlength=n_bins * _N_LEVEL_BINS
        )
        return cls(
            cells=counts.view(class_count, _N_SLOPE_BINS, _N_LEVEL_BINS),
            slope=add(slope),
            total=add(inside * value),
            squares=add(inside * value**2),
            steepest_deg=steepest,
        )

    def __add__(self, addend: "SlopeSums") -> "SlopeSums":
        """Return the sums over the cells of two parts of the data."""
        return SlopeSums(
            cells=self.cells + addend.cells,
            slope=self.slope + addend.slope,
            total=self.total + addend.total,
            squares=self.squares + addend.squares,
            steepest_deg=torch.maximum(self.steepest_deg, addend.steepest_deg),
        )

    @property
    def count(self) -> Tensor:
        """Number of cells per class, int64, shape [C]."""
        return self.cells.sum((1, 2))

    def bins(self, censored: bool) -> dict[str, Tensor]:
        """Return the sums that the likelihood needs, up to the steepest non-empty bin.

        Args:
            censored: whether λ was clipped to 0 and 1; otherwise 0 and 1 are ordinary
                values.

        Returns:
            `slope_deg` (mean slope of a bin), `zeros` and `ones` (numbers of cells clipped
            to 0 and to 1), `inside` (number of all other cells), `total` and `squares`
            (sums of λ and λ² over these other cells), float64, each of shape [C, B]; and
            `count`, the number of cells per class, shape [C].
        """
        cells = self.cells.sum(2).double()
        occupied = cells.sum(0).nonzero().flatten().tolist()
        size = max([0, *occupied]) + 1
        at_0 = self.cells[..., 0].double()
        at_1 = self.cells[..., -1].double()
        zeros = at_0 * censored
        ones = at_1 * censored
        uncensored_ones = at_1 - ones
        centres = (torch.arange(_N_SLOPE_BINS, dtype=torch.float64) + 0.5) * BIN_DEG
        mean_slope = self.slope / cells.clamp(min=1)
        sums = {
            "slope_deg": torch.where(cells > 0, mean_slope, centres),
            "zeros": zeros,
            "ones": ones,
            "inside": cells - zeros - ones,
            "total": self.total + uncensored_ones,
            "squares": self.squares + uncensored_ones,
        }
        bins = {name: values[:, :size].clone() for name, values in sums.items()}
        return {**bins, "count": self.count}


def levels() -> Tensor:
    """Return λ of each bin: 0, the centres of the inner bins, 1; float64, shape [V]."""
    inside = (torch.arange(INSIDE_BINS, dtype=torch.float64) + 0.5) / INSIDE_BINS
    return torch.cat([torch.zeros(1), inside, torch.ones(1)])


def sum_cells(parts: Iterable[Cells], class_count: int) -> SlopeSums:
    """Sum the cells of all parts of the data, one part at a time.

    Args:
        parts: cells of each part of the data; at least one part.
        class_count: C, number of classes.
    """
    sums = (SlopeSums.of(cells, class_count) for cells in parts)
    return reduce(SlopeSums.__add__, sums)


def sum_split(dataset: TerrainDataset, split: str) -> SlopeSums:
    """Sum all observed cells of a split, read in chunks of maps.

    Raises:
        DatasetError: If the split does not exist or has no observed cells.
    """
    chunks = read_cells(dataset, split)
    sums = sum_cells(chunks, len(dataset.recipe.classes))
    if not int(sums.count.sum()):
        raise DatasetError(
            f"Expected observed traversability in split {split!r} of {dataset.path}, "
            "got NaN in every cell. Train on maps that a robot has driven over."
        )
    return sums


def cell_nll(cells: Cells, table: SlopeTable) -> float:
    """Return the mean negative log-likelihood of cells, each under its own class.

    Args:
        cells: cells whose classes are in the table.
        table: tabulated GPs.

    Returns:
        Mean over all cells, with the log density in (0, 1) and the log mass at 0 and 1.
    """
    class_id = cells.class_id.view(1, 1, -1)
    mixture = table.predict_by_class(class_id, cells.slope_deg.view(1, 1, -1))
    log_prob = mixture.log_prob(cells.traversability.view(1, 1, -1))
    return -float(log_prob.double().mean())


def measure_latent(
    table: SlopeTable, chunks: Iterable[Terrain], truth: bool = True
) -> dict[str, float]:
    """Measure the GPs without the classifier: each labelled cell under its own class.

    Args:
        table: tabulated GPs.
        chunks: chunks of maps; at least one map.
        truth: whether the maps contain the true distribution of λ.

    Returns:
        `nll`, the mean negative log-likelihood of realised λ. If the truth is available,
        also `latent_rmse`, the root mean square error of the latent mean, and
        `noise_error`, the maximum relative error of the noise's standard deviation over
        the classes that occur.
    """
    nll_sum = 0.0
    n_observed = 0
    square_sum = 0.0
    n_cells = 0
    noise_error = 0.0
    for terrain in chunks:
        labelled = terrain.class_id != UNLABELLED
        class_id = terrain.class_id[labelled].unsqueeze(0)
        slope_deg = terrain.slope_deg[labelled].unsqueeze(0)
        traversability = terrain.traversability[labelled].unsqueeze(0)
        predicted = table.predict_by_class(class_id, slope_deg)
        true = terrain.truth.at(labelled)
        is_observed = ~traversability.isnan()
        log_prob = predicted.log_prob(traversability)[is_observed]
        nll_sum -= float(log_prob.double().sum())
        n_observed += int(is_observed.sum())
        error = (predicted.means[0] - true.means[0]).double()
        square_sum += float(error.square().sum())
        n_cells += class_id.numel()
        if class_id.numel():
            ratio = table.noise_std[class_id] / true.stds[0]
            noise_error = max(noise_error, float((ratio - 1).abs().max()))
    nll = nll_sum / max(1, n_observed)
    if not truth:
        return {"nll": nll}
    latent_rmse = (square_sum / max(1, n_cells)) ** 0.5
    return {"latent_rmse": latent_rmse, "noise_error": noise_error, "nll": nll}
