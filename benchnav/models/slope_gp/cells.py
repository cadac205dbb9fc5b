"""Cells that a robot has driven over, from maps or from slip logs: what the class-wise GPs learn from.

Cells whose slope or traversability was not observed (NaN), or whose class is not known, are left out. Letters in
shapes: N cells, C classes.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.errors import ConfigError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.slope_gp.table import SlopeTable

CHUNK_CELLS = 2**18


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
        return Cells(
            class_id=self.class_id[which],
            slope_deg=self.slope_deg[which],
            traversability=self.traversability[which],
        )


def observed_cells(class_id: Tensor, slope_deg: Tensor, traversability: Tensor, class_count: int) -> Cells:
    """Takes out the cells whose slope and traversability were observed and whose class is known.

    Args:
        class_id: integers in [0, C), 255 where not known, any shape.
        slope_deg: slopes in [0, 90], NaN where not observed, shape of `class_id`.
        traversability: λ in [0, 1], NaN where not observed, shape of `class_id`.
        class_count: C.

    Raises:
        ConfigError: the columns differ in length, or hold values out of range.
    """
    ids, slopes, values = (column.flatten() for column in (class_id, slope_deg, traversability))
    if not len(ids) == len(slopes) == len(values):
        raise ConfigError(
            "Expected `class_id`, `slope_deg` and `traversability` of one length, "
            f"got {len(ids)}, {len(slopes)} and {len(values)}."
        )
    seen = ~(slopes.isnan() | values.isnan()) & (ids != UNLABELLED)
    cells = Cells(class_id=ids[seen].long(), slope_deg=slopes[seen], traversability=values[seen])
    _check_range("class_id", cells.class_id, class_count - 1)
    _check_range("slope_deg", cells.slope_deg, 90)
    _check_range("traversability", cells.traversability, 1)
    return cells


def read_cells(dataset: TerrainDataset, split: str, chunk_cells: int = CHUNK_CELLS) -> Iterator[Cells]:
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
        class_id, slope_deg, traversability = (torch.from_numpy(maps[name]) for name in names)
        yield observed_cells(class_id, slope_deg, traversability, len(dataset.recipe.classes))


def hold_out(cells: Cells, share: float, seed: int = 0) -> tuple[Cells, Cells]:
    """Splits cells class by class: those held out follow one another, from a place that is drawn.

    Rows that a robot logs one after the other are alike, so that single rows drawn from among them would tell how well
    neighbours are known rather than the ground of another drive.

    Args:
        cells: of any classes, in the order in which they were driven over.
        share: of each class's cells to hold out, in (0, 1); rounded down, so that one cell is kept.
        seed: root seed of the draw.

    Returns:
        The cells to learn from, and those held out.

    Raises:
        ConfigError: the share is out of range, or no class has cells enough to hold one out.
    """
    if not 0 < share < 1:
        raise ConfigError(f"Expected `share` in (0, 1), got {share}.")
    counts = cells.class_id.bincount(minlength=1)
    out = (counts * share).long()
    if not int(out.sum()):
        raise ConfigError(
            f"Expected a class with at least {int(np.ceil(1 / share))} cells to hold {share:.0%} of them "
            f"out, got at most {int(counts.max())}. Log more, or hold out a larger `share`."
        )
    key = rng.stream_key(seed, "models", "held-out cells")
    held = torch.zeros(len(cells), dtype=torch.bool)
    for c, (count, few) in enumerate(zip(counts.tolist(), out.tolist(), strict=True)):
        first = int(rng.uniform(key, np.array([c]))[0] * (count - few + 1))
        held[(cells.class_id == c).nonzero().flatten()[first : first + few]] = True
    return cells.select(~held), cells.select(held)


def cell_nll(cells: Cells, table: SlopeTable) -> float:
    """Mean negative log likelihood of cells, each read with its own class.

    Args:
        cells: of the classes of the table.
        table: the GPs.

    Returns:
        The mean over all cells: of the log density inside (0, 1), of the log mass at 0 and 1.

    Raises:
        ConfigError: there are cells of more classes, or none at all.
    """
    classes = len(table.noise_std)
    if not len(cells) or int(cells.class_id.max()) >= classes:
        got = f"of {int(cells.class_id.max()) + 1}" if len(cells) else "none"
        raise ConfigError(
            f"Expected cells of {classes} classes, got {got}. Give cells of the classes that the GPs were "
            "trained on."
        )
    mixture = table.own(cells.class_id.view(1, 1, -1), cells.slope_deg.view(1, 1, -1))
    return -float(mixture.log_prob(cells.traversability.view(1, 1, -1)).double().mean())


def _check_range(name: str, column: Tensor, most: float) -> None:
    if not bool(((column >= 0) & (column <= most)).all()):
        raise ConfigError(f"Expected `{name}` within [0, {most}], got values outside it.")
