"""Traversability of driven cells, and the split of each drive.

Each split has a strip of the terrain; terrain between strips is on no map (`tiling`). A
drive usually belongs to the split whose strip contains most of the drive's rows. Its
rows on other strips are left out, so no cell and no drive occurs in two splits. Letters
in shapes: N rows, D drives, M driven cells.
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
from benchnav.datagen.dem.crs import is_in_metres, transformed
from benchnav.datagen.dem.drive_log import (
    OVER_SPEED,
    POSITION_COLUMNS,
    REASONS,
    DriveLog,
)
from benchnav.datagen.dem.raster import Layer, Raster
from benchnav.datagen.dem.tiling import Tiling
from benchnav.datagen.schema import Json

BANDS = ("traversability", "drive_count", "drive_std")
RATIO_LIMITS = (0.0, 1.0)  # limits of stored λ, to which ratios of rows are clipped
_BLOCK_ROWS = 64  # rows of cells that are read at once
_CRS_REMEDY = "Log x_m and y_m in that CRS, or longitude_deg and latitude_deg."


@dataclass(frozen=True)
class DrivenCells:
    """Cells that drives crossed, with statistics of λ in each cell.

    Args:
        cells: index of each cell, row · width + column, ascending, int64, shape [M].
        values: values of `BANDS`: mean of λ, number of rows, standard deviation of λ
            (NaN for one row), shape [3, M].
        width: number of columns of the terrain.
    """

    cells: ndarray
    values: ndarray
    width: int

    def read(self, rows: range, columns: range) -> ndarray:
        """Return the values of all cells in a block of rows and columns.

        Args:
            rows: indices of the rows, counted northward.
            columns: indices of the columns, counted eastward.

        Returns:
            Values of `BANDS`, float64, shape [3, len(rows), len(columns)]; NaN, 0 and
            NaN in cells that were not driven.
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


def to_map_crs(log: DriveLog, dem: Raster, crs: Any, bounds: Any) -> DriveLog:
    """Return a log with positions in the CRS of the maps.

    Positions are in metres from the south-west corner of the elevation model.

    Args:
        log: log with positions as logged.
        dem: elevation model.
        crs: CRS of the maps.
        bounds: bounds of the elevation model in `crs`.

    Returns:
        The log without rows off the elevation model.

    Raises:
        DatasetError: If all rows lie off the elevation model, or positions are in the
            CRS of the elevation model and this CRS is not in metres.
    """
    log_crs: Any = "EPSG:4326"
    if not log.is_geographic:
        log_crs = dem.file.crs
        _check_in_metres(log, dem)
    corner_m = np.array([[bounds.left], [bounds.bottom]])
    x = log.rows["x"]
    y = log.rows["y"]
    positions_m = transformed(log_crs, crs, x, y) - corner_m
    is_off = ~_is_within(positions_m, bounds)
    if is_off.all():
        swapped_m = transformed(log_crs, crs, y, x) - corner_m
        is_swapped = bool(_is_within(swapped_m, bounds).any())
        raise _off_terrain_error(log, dem, is_swapped=is_swapped)
    x_m, y_m = positions_m
    rows = log.rows.assign(x=x_m, y=y_m)
    return replace(log, rows=rows).without("off_dem", is_off)


def _check_in_metres(log: DriveLog, dem: Raster) -> None:
    """Check that the CRS of the elevation model and the log is in metres."""
    crs = dem.file.crs
    if is_in_metres(crs):
        return
    raise DatasetError(
        f"Expected columns `longitude_deg` and `latitude_deg` in {log.settings.file}, "
        "got `x_m` and `y_m`, which require an elevation model in metres. The CRS of "
        f"{dem.name} is {crs.to_string()[:80]}. Log the positions in WGS 84."
    )


def _off_terrain_error(log: DriveLog, dem: Raster, *, is_swapped: bool) -> DatasetError:
    """Return the error for a log whose positions all lie off the elevation model.

    Args:
        log: log of the drives.
        dem: elevation model.
        is_swapped: whether some positions lie on `dem` if x and y are swapped.
    """
    covered = dem.file.bounds
    west, east = log.rows["x"].agg(["min", "max"])
    south, north = log.rows["y"].agg(["min", "max"])
    names = POSITION_COLUMNS["WGS 84" if log.is_geographic else "crs"]
    columns = " and ".join(f"`{name}`" for name in names)
    remedy = _CRS_REMEDY
    if log.is_geographic:
        remedy = f"Convert {columns} to degrees in WGS 84."
    if is_swapped:
        remedy = f"Swap {columns}."
    return DatasetError(
        f"Expected positions on {dem.name}, got {names[0]} {west:.9g} to {east:.9g} "
        f"and {names[1]} {south:.9g} to {north:.9g} in {log.settings.file}. {dem.name} "
        f"covers x {covered.left:.9g} to {covered.right:.9g} and y "
        f"{covered.bottom:.9g} to {covered.top:.9g} of "
        f"{dem.file.crs.to_string()[:80]}. {remedy}"
    )


def _is_within(positions_m: ndarray, bounds: Any) -> ndarray:
    """Return whether positions lie on the elevation model, bool, shape [N]."""
    width_m = bounds.right - bounds.left
    height_m = bounds.top - bounds.bottom
    size_m = np.array([[width_m], [height_m]])
    is_within = (positions_m >= 0) & (positions_m < size_m)
    return np.all(is_within, axis=0)


def check_drive_count(log: DriveLog, splits: Sequence[str]) -> None:
    """Check that a log has at least as many drives as splits.

    Raises:
        DatasetError: If the log has fewer drives.
    """
    n_drives = log.rows["drive"].nunique()
    if n_drives < len(splits):
        raise DatasetError(
            f"Expected a drive for each of the {len(splits)} splits "
            f"{', '.join(splits)}, got {n_drives} in "
            f"{log.settings.file}. Add a column `drive` with the name of each row's "
            "drive, or use fewer --splits."
        )


def elevation_under(layer: Layer, row: ndarray, column: ndarray) -> ndarray:
    """Return the elevation at positions, interpolated between cells.

    Args:
        layer: elevation in metres.
        row: row coordinate of each position, northward from the centre of the first
            cell, float64, shape [N].
        column: column coordinate, eastward from the same centre, shape [N].

    Returns:
        Elevation in metres, NaN off the layer's cells, float64, shape [N].
    """
    # A layer is padded by one cell on each side.
    height = layer.warped.height - 2
    width = layer.warped.width - 2
    elevation_m = np.full(len(row), np.nan)
    block = np.floor(np.clip(row, 0, height - 1) / _BLOCK_ROWS).astype(np.int64)
    for index in np.unique(block).tolist():
        is_in_block = block == index
        start = index * _BLOCK_ROWS
        stop = min(start + _BLOCK_ROWS, height)
        cells_m = layer.read(range(start, stop), range(width))[0]
        padded_row = row[is_in_block] - start + 1
        padded_column = column[is_in_block] + 1
        elevation_m[is_in_block] = ndimage.map_coordinates(
            cells_m, (padded_row, padded_column), order=1, cval=np.nan
        )
    return elevation_m


def aggregate_drives(
    log: DriveLog, tiling: Tiling, row: ndarray, column: ndarray
) -> tuple[DriveLog, DrivenCells]:
    """Assign drives to splits, and aggregate λ over the rows on each cell.

    Args:
        log: log with λ in each row.
        tiling: tiling of the terrain into maps and splits.
        row: row of the cell of each position, counted northward, int64, shape [N].
        column: column of the cell, counted eastward, int64, shape [N].

    Returns:
        The log without rows that lie between maps or on another split's terrain, and
        the driven cells.

    Raises:
        DatasetError: If a split gets no drive.
    """
    split_of_row = tiling.split_of(row, column)
    rows = log.rows.assign(row=row, column=column, split=split_of_row)
    log = replace(log, rows=rows)
    log = log.without("between_maps", split_of_row < 0)
    split_by_drive = _split_by_drive(log, list(tiling.strips))
    split_of_drive = split_by_drive[log.rows["drive"]]
    is_on_other_split = log.rows["split"].to_numpy() != split_of_drive
    log = log.without("other_split", is_on_other_split)
    width = tiling.cells[1]
    cell = log.rows["row"] * width + log.rows["column"]
    # Ratios below 0 or above 1 remain in the log, but stored λ is in [0, 1].
    stored = log.rows["traversability"].clip(*RATIO_LIMITS)
    driven = stored.groupby(cell).agg(["mean", "count", "std"])
    values = driven.to_numpy(np.float64).T
    return log, DrivenCells(driven.index.to_numpy(), values, width)


def describe_drives(log: DriveLog, splits: Sequence[str]) -> Json:
    """Return the manifest entry of a log from `aggregate_drives`."""
    used = {}
    drives = {}
    for index, split in enumerate(splits):
        rows = log.rows[log.rows["split"] == index]
        used[split] = len(rows)
        drives[split] = [log.names[drive] for drive in np.unique(rows["drive"])]
    # Reasons are stored in the order of the checks, which is the order of `REASONS`.
    left_out = {
        reason: log.left_out[reason] for reason in REASONS if reason in log.left_out
    }
    ratio = log.rows["traversability"]
    beyond = {
        "below_0": int((ratio < 0).sum()),
        "above_1": int((ratio > 1).sum()),
        "above_1.2": int((ratio > OVER_SPEED).sum()),
    }
    return {
        "file": Path(log.settings.file).name,
        "sha256": log.sha256,
        "least_speed_m_s": log.settings.least_speed,
        "ratio_limits": list(RATIO_LIMITS),
        "rows": len(log.rows) + sum(log.left_out.values()),
        "used": used,
        "left_out": left_out,
        "beyond": beyond,
        "drives": drives,
        "speed": log.settings.speed,
        "pace": log.motion.get("pace"),
        "commanded_pace": log.motion.get("commanded_pace"),
        "standing": log.motion.get("standing", 0),
        "reverses": log.motion.get("reverses", 0),
        "period_s": log.motion.get("period_s"),
        "resolution_m": log.motion.get("resolution_m", 0),
    }


def _split_by_drive(log: DriveLog, splits: Sequence[str]) -> ndarray:
    """Return the index of each drive's split, int64, shape [D].

    First, each split gets one drive, chosen so that the fewest rows are lost. Each
    remaining drive belongs to the split with most of the drive's rows.

    Raises:
        DatasetError: If a split gets no drive.
    """
    counts = np.zeros((len(splits), len(log.names)))
    np.add.at(counts, (log.rows["split"], log.rows["drive"]), 1)
    split_by_drive = counts.argmax(axis=0)
    n_lost = counts.max(axis=0) - counts
    impossible = 2.0 * counts.sum() + 1
    costs = np.where(counts > 0, n_lost, impossible)
    assigned, drives = linear_sum_assignment(costs)
    split_by_drive[drives] = assigned
    is_empty = counts[assigned, drives] == 0
    empty = [splits[split] for split in assigned[is_empty]]
    if empty:
        raise DatasetError(
            "Expected at least one drive on the terrain of each split, got none for "
            f"{', '.join(empty)} in {log.settings.file}. A drive belongs to only one "
            "split. Use fewer --splits, other fractions, smaller maps, or drives over "
            "more terrain."
        )
    return split_by_drive
