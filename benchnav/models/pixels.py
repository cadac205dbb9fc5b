"""Training data of the class-wise GPs: tables of cells by class.

Cells whose slope or traversability was not observed (NaN) are left out. Where a class has more cells
than are kept, they are drawn as evenly over slope as they come, band by band, from a named random
stream: the GPs learn λ given slope, which no choice by slope biases, and rare steep cells, where the
function is least known, are all kept. Letters in shapes: C classes, N cells a class.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchnav import rng
from benchnav.datagen.store import TerrainDataset
from benchnav.errors import ConfigError, DatasetError
from benchnav.mixture import TraversabilityMixture
from benchnav.models.slope_table import SlopeTable

_BAND_DEG = 1.0


@dataclass(frozen=True, kw_only=True)
class PixelTable:
    """Cells by class: what the GPs learn from. Rows are padded with zeros to one length.

    Args:
        slope_deg: float32, shape [C, N].
        traversability: observed λ in [0, 1], float32, shape [C, N].
        count: how many of a row's entries hold data, int64, shape [C].
    """

    slope_deg: Tensor
    traversability: Tensor
    count: Tensor

    @property
    def steepest_deg(self) -> Tensor:
        """Steepest slope of each class, 0 for one without cells, shape [C]."""
        return self.slope_deg.amax(1)

    @classmethod
    def group(
        cls,
        class_id: Tensor,
        slope_deg: Tensor,
        traversability: Tensor,
        class_count: int,
        max_points: int = 10_000,
        seed: int = 0,
    ) -> "PixelTable":
        """Groups logged cells by class, keeping at most some of each, drawn without replacement.

        Args:
            class_id: integers in [0, C), any shape.
            slope_deg: slopes in [0, 90], NaN where not observed, shape of `class_id`.
            traversability: observed λ in [0, 1], NaN where not observed, shape of `class_id`.
            class_count: C.
            max_points: most cells to keep of a class.
            seed: root seed of the draw.

        Raises:
            ConfigError: the columns differ in length, hold values out of range, or nothing observed.
        """
        ids, slopes, values = (column.flatten() for column in (class_id, slope_deg, traversability))
        _check_lengths(ids, slopes, values, max_points)
        observed = ~(slopes.isnan() | values.isnan())
        if not bool(observed.any()):
            raise ConfigError(
                "Expected at least one cell with a slope and a traversability, got NaN in all "
                f"{len(observed)}. Give cells that a robot has driven over."
            )
        ids, slopes, values = ids[observed], slopes[observed], values[observed]
        _check_ranges(class_id=(ids, class_count - 1), slope_deg=(slopes, 90), traversability=(values, 1))
        key = rng.stream_key(seed, "models", "pixels")
        rows = [_draw_rows(ids, slopes, c, key, max_points) for c in range(class_count)]
        return _pack([slopes[row] for row in rows], [values[row] for row in rows])


def read_pixels(dataset: TerrainDataset, split: str, max_points: int = 10_000, seed: int = 0) -> PixelTable:
    """Reads the observed cells of a split, by class.

    Args:
        dataset: where they are.
        split: name of a split.
        max_points: most cells to keep of a class.
        seed: root seed of the draw.

    Raises:
        DatasetError: there is no such split, or nothing was observed in it.
    """
    names = ("class_id", "slope_deg", "traversability")
    maps = dataset.read(split, fields=names)
    class_id, slope_deg, traversability = (torch.from_numpy(maps[name]) for name in names)
    if bool((slope_deg.isnan() | traversability.isnan()).all()):
        raise DatasetError(
            f"Expected observed traversability in split {split!r} of {dataset.path}, got NaN in every cell. "
            "Train on maps that a robot has driven over."
        )
    classes = len(dataset.recipe.classes)
    return PixelTable.group(class_id, slope_deg, traversability, classes, max_points, seed)


def hold_out(table: PixelTable, share: float, seed: int = 0) -> tuple[PixelTable, PixelTable]:
    """Splits a table at random, class by class.

    Args:
        table: cells by class.
        share: of each class's cells to hold out, in (0, 1); rounded down, so that one cell is kept.
        seed: root seed of the draw.

    Returns:
        The cells to learn from, and those held out.

    Raises:
        ConfigError: the share is out of range, or no class has cells enough to hold one out.
    """
    if not 0 < share < 1:
        raise ConfigError(f"Expected `share` in (0, 1), got {share}.")
    held = (table.count * share).long()
    if not int(held.sum()):
        raise ConfigError(
            f"Expected a class with at least {int(np.ceil(1 / share))} cells to hold {share:.0%} of them "
            f"out, got at most {int(table.count.max())}. Log more, or hold out a larger `share`."
        )
    key = rng.stream_key(seed, "models", "held-out pixels")
    parts: list[list[Tensor]] = [[], []]
    for c, (count, out) in enumerate(zip(table.count.tolist(), held.tolist(), strict=True)):
        order = torch.from_numpy(rng.permutation(key, np.array([c]), count)[0])
        parts[0].append(order[out:].sort().values)
        parts[1].append(order[:out].sort().values)
    kept, tested = (
        _pack(
            [table.slope_deg[c, row] for c, row in enumerate(rows)],
            [table.traversability[c, row] for c, row in enumerate(rows)],
        )
        for rows in parts
    )
    return kept, tested


def pixel_nll(pixels: PixelTable, table: SlopeTable) -> float:
    """Mean negative log likelihood of cells, each read with its own class.

    Args:
        pixels: cells by class, of C classes.
        table: the GPs of the same classes.

    Returns:
        The mean over all cells: of the log density inside (0, 1), of the log mass at 0 and 1.

    Raises:
        ConfigError: the classes differ in number, or there are no cells.
    """
    if len(pixels.count) != len(table.noise_std) or not int(pixels.count.sum()):
        raise ConfigError(
            f"Expected cells of {len(table.noise_std)} classes, got {int(pixels.count.sum())} of "
            f"{len(pixels.count)} classes. Give cells of the classes that the GPs were trained on."
        )
    total = 0.0
    for c, count in enumerate(pixels.count.tolist()):
        mean, std = (v[c].view(1, 1, -1) for v in table.lookup(pixels.slope_deg[c : c + 1, :count]))
        mixture = TraversabilityMixture(torch.ones_like(mean), mean, std)
        total -= float(mixture.log_prob(pixels.traversability[c : c + 1, :count]).double().sum())
    return total / int(pixels.count.sum())


def _pack(slopes: list[Tensor], values: list[Tensor]) -> PixelTable:
    count = torch.tensor([len(row) for row in slopes])
    table = torch.zeros(2, len(slopes), int(count.max()))
    for c, (slope, value) in enumerate(zip(slopes, values, strict=True)):
        table[0, c, : len(slope)], table[1, c, : len(value)] = slope, value
    return PixelTable(slope_deg=table[0], traversability=table[1], count=count)


def _draw_rows(ids: Tensor, slopes: Tensor, class_id: int, key: int, most: int) -> Tensor:
    rows = (ids == class_id).nonzero().flatten()
    if len(rows) <= most:
        return rows
    drawn = rng.uniform(key, np.array([class_id]), (len(rows),))[0]
    bands = (slopes[rows] / _BAND_DEG).long().numpy()
    order = np.lexsort((drawn, bands))
    # Bands take turns at giving a cell: a cell's turn is its place in the random order of its band.
    sizes = np.bincount(bands)
    turn = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    first = np.argpartition(turn + drawn[order], most)[:most]
    return rows[torch.from_numpy(np.sort(order[first]))]


def _check_lengths(ids: Tensor, slopes: Tensor, values: Tensor, max_points: int) -> None:
    if not len(ids) == len(slopes) == len(values) > 0:
        raise ConfigError(
            "Expected `class_id`, `slope_deg` and `traversability` of one length > 0, "
            f"got {len(ids)}, {len(slopes)} and {len(values)}."
        )
    if max_points < 1:
        raise ConfigError(f"Expected `max_points` ≥ 1, got {max_points}.")


def _check_ranges(**limits: tuple[Tensor, float]) -> None:
    for name, (column, most) in limits.items():
        if not bool(((column >= 0) & (column <= most)).all()):
            raise ConfigError(f"Expected `{name}` within [0, {most}], got values outside it.")
