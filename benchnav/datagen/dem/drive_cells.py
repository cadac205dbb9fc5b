"""Traversability of the cells that drives cross, and the split that each drive belongs
to.

Splits have strips of the ground, with ground between them that no map shows (`tiling`).
A drive belongs to the split on whose strip most of its rows lie, and its rows on the
strip of another are left out. So no cell and no drive tells two
splits anything. Letters in shapes: N rows, D drives, S splits, M cells that were driven
over.
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
    """Cells that were driven over.

    Args:
        cells: number of each, row · width + column, ascending, int64, shape [M].
        values: of each of `BANDS`: mean of λ, number of rows, standard deviation of λ
            (NaN of one row), shape [3, M].
        width: cells of the ground eastward.
    """

    cells: ndarray
    values: ndarray
    width: int

    def read(self, rows: range, columns: range) -> ndarray:
        """Read cells.

        Args:
            rows: counted northward.
            columns: counted eastward.

        Returns:
            `BANDS`, float64, shape [3, len(rows), len(columns)]; NaN, 0 and NaN where
            no one drove.
        """
        read = np.full((3, len(rows), len(columns)), np.nan)
        read[1] = 0
        in_rows = slice(
            *np.searchsorted(
                self.cells, [rows.start * self.width, rows.stop * self.width]
            )
        )
        row, column = np.divmod(self.cells[in_rows], self.width)
        is_read = (column >= columns.start) & (column < columns.stop)
        read[:, row[is_read] - rows.start, column[is_read] - columns.start] = (
            self.values[:, in_rows][:, is_read]
        )
        return read


def lay_out(log: DriveLog, ground: Raster, crs: Any, bounds: Any) -> DriveLog:
    """Move positions into the CRS of the maps, as metres from the south-west corner of
    the elevation model.

    Args:
        log: with positions as they were logged.
        ground: the elevation model.
        crs: of the maps.
        bounds: of the elevation model in that.

    Returns:
        The log with the rows that lie on it.

    Raises:
        DatasetError: If none does, or the log is in a CRS that is not in metres.
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
        left, bottom, right, top = ground.file.bounds
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
            f"Expected positions on {ground.name}, which covers x {left:.9g} to "
            f"{right:.9g} and y {bottom:.9g} to "
            f"{top:.9g} of {ground_crs.to_string()[:80]}, got {names[0]} {west:.9g} "
            f"to {east:.9g} and {names[1]} "
            f"{south:.9g} to {north:.9g} in {path}. {remedy}"
        )
    return replace(log, rows=log.rows.assign(x=x, y=y)).without("off_dem", off)


def _is_within(positions_m: ndarray, bounds: Any) -> ndarray:
    """Return whether positions from the south-west corner lie on the elevation model,
    bool, shape [N].
    """
    size = np.array([[bounds.right - bounds.left], [bounds.top - bounds.bottom]])
    return np.all((positions_m >= 0) & (positions_m < size), axis=0)


def check_enough(log: DriveLog, splits: Sequence[str]) -> None:
    """Require a drive for each split.

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
    """Interpolate elevation between the cells of the maps and the one around them.

    Args:
        log: the drives.
        layer: elevation, in metres.
        row: of each row of the log, counted northward from the middle of the first
            cell, float64, shape [N].
        column: counted eastward.

    Returns:
        float64, NaN off the cells, shape [N].
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
    """Assign each drive to a split and take the mean of λ over the rows on each cell.

    Args:
        log: the drives.
        tiling: how the ground is cut into maps and splits.
        row: of the cell that each row of the log lies on, counted northward, int64,
            shape [N].
        column: counted eastward, int64, shape [N].

    Returns:
        The log with the rows that are used, and what they say of the cells.

    Raises:
        DatasetError: If no drive is left for a split.
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
    # A row that slides back or exceeds its command stays as it is in the log; what is
    # stored is a fraction.
    stored = log.rows["traversability"].clip(*RATIO_LIMITS)
    driven = stored.groupby(cell).agg(["mean", "count", "std"])
    return log, DrivenCells(
        driven.index.to_numpy(), driven.to_numpy(np.float64).T, width
    )


def describe_drives(log: DriveLog, splits: Sequence[str]) -> Json:
    """Return the manifest's entry on a log from `drive_over`: what was used and what
    was left out.
    """
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

    Every split gets a drive for which the fewest rows are lost by that; the others go
    where most of their rows lie.
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
