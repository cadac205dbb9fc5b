"""Traversability of driven cells, and the split of each drive.

Splits have strips of the terrain; terrain between them is in no map (`tiling`). A drive
belongs to the split whose strip contains most of its rows. Its rows on other strips are
left out, so no cell and no drive occurs in two splits. Letters in shapes: N rows, D
drives, S splits, M driven cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from benchnav.core.errors import DatasetError
from benchnav.datagen.dem.drive_log import OVER_SPEED, PLACES, REASONS, DriveLog
from benchnav.datagen.dem.raster import Layer, Raster, transformed
from benchnav.datagen.dem.tiling import Tiling
from benchnav.datagen.schema import Json

BANDS = ("traversability", "drive_count", "drive_std")
RATIO_LIMITS = (0.0, 1.0)  # that the ratio of a row is clipped to when it is stored
_BLOCK_CELLS = 64  # rows of cells that are read at once
_PROJECT = "Give x_m and y_m in that CRS, or longitude_deg and latitude_deg."


@dataclass(frozen=True)
class DrivenCells:
    """Driven cells.

    Args:
        cells: index of each, row · width + column, ascending, int64, shape [M].
        values: values of `BANDS`: mean of λ, number of rows, standard deviation of λ
            (NaN for one row), shape [3, M].
        width: number of columns of the terrain.
    """

    cells: ndarray
    values: ndarray
    width: int

    def read(self, rows: range, columns: range) -> ndarray:
        """Return the values of cells.

        Args:
            rows: rows, counted northward.
            columns: columns, counted eastward.

        Returns:
            `BANDS`, float64, shape [3, len(rows), len(columns)]; NaN, 0 and NaN in
            cells that were not driven.
        """
        bands = np.full((3, len(rows), len(columns)), np.nan)
        bands[1] = 0
        ends = [rows.start * self.width, rows.stop * self.width]
        in_rows = slice(*np.searchsorted(self.cells, ends))
        row, column = np.divmod(self.cells[in_rows], self.width)
        is_inside = (column >= columns.start) & (column < columns.stop)
        row = row[is_inside] - rows.start
        column = column[is_inside] - columns.start
        bands[:, row, column] = self.values[:, in_rows][:, is_inside]
        return bands


def lay_out(log: DriveLog, ground: Raster, crs: Any, bounds: Any) -> DriveLog:
    """Return a log with positions in the CRS of the maps.

    They are metres from the south-west corner of the elevation model.

    Args:
        log: log with positions as logged.
        ground: the elevation model.
        crs: CRS of the maps.
        bounds: bounds of the elevation model in `crs`.

    Returns:
        The log with the rows on the elevation model.

    Raises:
        DatasetError: If no row is on it, or the CRS of the log is not in metres.
    """
    ground_crs, path = ground.file.crs, log.settings.file
    if not log.is_geographic and not (
        ground_crs.is_projected and ground_crs.linear_units_factor[1] == 1
    ):
        raise DatasetError(
            f"Expected positions as longitude_deg and latitude_deg in {path}, since "
            f"the CRS of {ground.name}, "
            f"{ground_crs.to_string()[:80]}, is not in metres, got x_m and y_m. Log "
            "them in WGS 84."
        )
    source_crs = "EPSG:4326" if log.is_geographic else ground_crs
    corner = np.array([[bounds.left], [bounds.bottom]])
    x, y = positions = (
        transformed(source_crs, crs, log.rows["x"], log.rows["y"]) - corner
    )
    off = ~_is_within(positions, bounds)
    if off.all():
        covered = ground.file.bounds
        (west, east), (south, north) = (
            log.rows[name].agg(["min", "max"]) for name in ("x", "y")
        )
        names = PLACES["WGS 84" if log.is_geographic else "crs"]
        columns = " and ".join(f"`{name}`" for name in names)
        remedy = (
            f"Convert {columns} to degrees in WGS 84."
            if log.is_geographic
            else _PROJECT
        )
        swapped = transformed(source_crs, crs, log.rows["y"], log.rows["x"]) - corner
        if _is_within(swapped, bounds).any():
            remedy = f"Swap {columns}."
        raise DatasetError(
            f"Expected positions on {ground.name}, which covers x {covered.left:.9g} to "
            f"{covered.right:.9g} and y {covered.bottom:.9g} to {covered.top:.9g} of "
            f"{ground_crs.to_string()[:80]}, got {names[0]} {west:.9g} to {east:.9g} "
            f"and {names[1]} {south:.9g} to {north:.9g} in {path}. {remedy}"
        )
    return replace(log, rows=log.rows.assign(x=x, y=y)).without("off_dem", off)


def _is_within(positions_m: ndarray, bounds: Any) -> ndarray:
    """Return whether positions lie on the elevation model, bool, shape [N]."""
    size = np.array([[bounds.right - bounds.left], [bounds.top - bounds.bottom]])
    return np.all((positions_m >= 0) & (positions_m < size), axis=0)


def check_enough(log: DriveLog, splits: Sequence[str]) -> None:
    """Check that there is a drive for each split.

    Raises:
        DatasetError: If the log has fewer drives.
    """
    drives = log.rows["drive"].nunique()
    if drives < len(splits):
        raise DatasetError(
            f"Expected a drive for each of the {len(splits)} splits "
            f"{', '.join(splits)}, got {drives} in "
            f"{log.settings.file}. Name drives in a column `drive`, or take fewer "
            "--splits."
        )


def elevation_under(
    log: DriveLog, layer: Layer, row: ndarray, column: ndarray
) -> ndarray:
    """Return the elevation at each row of a log, interpolated between cells.

    Args:
        log: the drives.
        layer: elevation in metres.
        row: row coordinate of each position, northward from the centre of the first
            cell, float64, shape [N].
        column: column coordinate, eastward.

    Returns:
        Metres, float64, NaN off the cells, shape [N].
    """
    height, width = layer.warped.height - 2, layer.warped.width - 2
    elevation_m = np.full(len(row), np.nan)
    block = np.floor(np.clip(row, 0, height - 1) / _BLOCK_CELLS).astype(np.int64)
    for start in np.unique(block) * _BLOCK_CELLS:
        is_in_block = block == start // _BLOCK_CELLS
        cells = layer.read(
            range(start, min(start + _BLOCK_CELLS, height)), range(width)
        )[0]
        # cells are padded by one
        positions = (
            row[is_in_block] - start + 1,
            column[is_in_block] + 1,
        )
        elevation_m[is_in_block] = ndimage.map_coordinates(
            cells, positions, order=1, cval=np.nan
        )
    return elevation_m


def drive_over(
    log: DriveLog, tiling: Tiling, row: ndarray, column: ndarray
) -> tuple[DriveLog, DrivenCells]:
    """Assign drives to splits, and aggregate λ over the rows on each cell.

    Args:
        log: the drives.
        tiling: tiling of the terrain into maps and splits.
        row: row of the cell of each position, counted northward, int64, shape [N].
        column: column of the cell, counted eastward, int64, shape [N].

    Returns:
        The log with the used rows, and the driven cells.

    Raises:
        DatasetError: If a split gets no drive.
    """
    rows = log.rows.assign(row=row, column=column, split=tiling.split_of(row, column))
    log = replace(log, rows=rows)
    log = log.without("between_maps", (rows["split"] < 0).to_numpy())
    splits = list(tiling.strips)
    owner = _owners(log, splits)
    log = log.without(
        "other_split", log.rows["split"].to_numpy() != owner[log.rows["drive"]]
    )
    width = tiling.cells[1]
    cell = log.rows["row"] * width + log.rows["column"]
    # Ratios below 0 or above 1 remain in the log, but stored λ is in [0, 1].
    stored = log.rows["traversability"].clip(*RATIO_LIMITS)
    driven = stored.groupby(cell).agg(["mean", "count", "std"])
    return log, DrivenCells(
        driven.index.to_numpy(), driven.to_numpy(np.float64).T, width
    )


def describe_drives(log: DriveLog, splits: Sequence[str]) -> Json:
    """Return the manifest entry of a log from `drive_over`: used and unused rows."""
    by_split = {
        split: log.rows[log.rows["split"] == index]
        for index, split in enumerate(splits)
    }
    return {
        "file": Path(log.settings.file).name,
        "sha256": log.sha256,
        "least_speed_m_s": log.settings.least_speed,
        "ratio_limits": list(RATIO_LIMITS),
        "rows": len(log.rows) + sum(log.left_out.values()),
        "used": {split: len(rows) for split, rows in by_split.items()},
        "left_out": {
            reason: log.left_out[reason] for reason in REASONS if reason in log.left_out
        },
        "beyond": {
            "below_0": int((log.rows["traversability"] < 0).sum()),
            "above_1": int((log.rows["traversability"] > 1).sum()),
            "above_1.2": int((log.rows["traversability"] > OVER_SPEED).sum()),
        },
        "drives": {
            split: [log.names[drive] for drive in np.unique(rows["drive"])]
            for split, rows in by_split.items()
        },
        "speed": log.settings.speed,
        "pace": log.motion.get("pace"),
        "commanded_pace": log.motion.get("commanded_pace"),
        "standing": log.motion.get("standing", 0),
        "reverses": log.motion.get("reverses", 0),
        "period_s": log.motion.get("period_s"),
        "resolution_m": log.motion.get("resolution_m", 0),
    }


def _owners(log: DriveLog, splits: Sequence[str]) -> ndarray:
    """Return the split of each drive, index into the splits, shape [D].

    Each split gets one drive, so that the fewest rows are lost. Other drives belong to
    the split with most of their rows.
    """
    counts = np.zeros((len(splits), len(log.names)))
    np.add.at(counts, (log.rows["split"], log.rows["drive"]), 1)
    owner = counts.argmax(axis=0)
    lost = np.where(counts > 0, counts.max(axis=0) - counts, 2.0 * counts.sum() + 1)
    chosen, drives = linear_sum_assignment(lost)
    owner[drives] = chosen
    empty = [
        splits[split]
        for split, drive in zip(chosen, drives, strict=True)
        if counts[split, drive] == 0
    ]
    if empty:
        raise DatasetError(
            "Expected a drive of its own on the ground of each split, got none for "
            f"{', '.join(empty)} in "
            f"{log.settings.file}. Take fewer --splits, other shares, smaller maps, "
            "or drives over more ground."
        )
    return owner
