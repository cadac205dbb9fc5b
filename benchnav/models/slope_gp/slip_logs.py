"""Slip logs of a robot, which can replace maps to train class-wise GPs.

A log is a table (CSV, TSV or Parquet) with one row per location driven over. Columns:
`class` (name or integer id), `slope_deg` (0–90), `traversability` (λ, 0–1; 1 minus the
slip ratio if the robot maintains its commanded speed), and optionally `drive` (name of
the drive). Other columns are ignored. Rows without slope or traversability are ignored
too.
"""

import hashlib
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from benchnav.core.errors import DatasetError
from benchnav.core.settings import hint
from benchnav.datagen.files.robot_logs import (
    read_log,
    read_names,
    read_numbers,
    require_columns,
)
from benchnav.models.slope_gp.cells import Cells

_LIMITS = {"slope_deg": (0, 90), "traversability": (0, 1)}
COLUMNS = ("class", *_LIMITS)
# With at least this many rows, a log whose slopes never exceed π/2 is taken to be in
# radians.
_MIN_ROWS_TO_CHECK_UNIT = 20
_MAX_CLASSES = 256  # class ids are stored in a byte


class SlipLog(NamedTuple):
    """Training data of a slip log.

    Args:
        class_names: names of the classes, in the order of their ids.
        cells: rows with a slope and a traversability, in the order of the log.
        digest: SHA-256 of the file.
        drive: index of the drive of each row in `cells`, int64, shape [N]; None if the
            log has no column `drive`.
    """

    class_names: tuple[str, ...]
    cells: Cells
    digest: str
    drive: Tensor | None


def read_slip_log(path: str | Path, class_names: tuple[str, ...] = ()) -> SlipLog:
    """Read a slip log.

    Args:
        path: path of the log, a CSV, TSV or Parquet file (`robot_logs.ENDINGS`).
        class_names: names of the classes, in the order of their ids. If empty, they are
            derived from the log: its class names in alphabetical order, or "0", "1", …
            up to the largest integer id.

    Raises:
        DatasetError: If the file does not exist, cannot be read, or has no row with
            slope and traversability; if a column is missing; if a class is not in
            `class_names`; or if a value is not numeric or out of range.
    """
    path = Path(path)
    rows = read_log(path)
    require_columns(rows, COLUMNS, path)
    for name, limits in _LIMITS.items():
        rows[name] = read_numbers(rows, name, path, limits)
    observed = rows.dropna(subset=list(_LIMITS))
    if observed.empty:
        raise DatasetError(
            f"Expected rows with a slope and a traversability in {path}, got 0 of "
            f"{len(rows)}. Log locations that the robot has driven over."
        )
    steepest = observed["slope_deg"].max()
    is_checked = len(observed) >= _MIN_ROWS_TO_CHECK_UNIT
    if is_checked and 0 < steepest <= np.pi / 2:
        raise DatasetError(
            f"Expected `slope_deg` in degrees in {path}, got at most {steepest:.4g} "
            f"in {len(observed)} rows, which suggests radians. Multiply radians by "
            "57.2958. If the slopes are in degrees, log steeper terrain too."
        )
    class_names, class_id = _read_classes(observed, path, class_names)
    slope = torch.from_numpy(observed["slope_deg"].to_numpy(np.float32))
    value = torch.from_numpy(observed["traversability"].to_numpy(np.float32))
    cells = Cells(class_id=class_id, slope_deg=slope, traversability=value)
    drive = None
    if "drive" in observed:
        drive_names = read_names(observed, "drive", path)
        drive_index = np.unique(drive_names, return_inverse=True)[1]
        drive = torch.from_numpy(drive_index)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return SlipLog(class_names, cells, digest, drive)


def _read_classes(
    rows: pd.DataFrame, path: Path, names: tuple[str, ...]
) -> tuple[tuple[str, ...], Tensor]:
    """Return the class names (those of the log if `names` is empty) and each row's id."""
    labels = read_names(rows, "class", path)
    log_classes: Any
    # pandas writes an integer id as 0.0 in a column with missing values.
    if all(re.fullmatch(r"\d+(\.\d*)?", label, re.ASCII) for label in labels):
        class_ids = labels.astype(float)
        fractional = labels[class_ids % 1 > 0]
        if len(fractional):
            raise DatasetError(
                f"Expected class ids as whole numbers in {path}, got {fractional[0]}. "
                "Use integer ids or names for the classes."
            )
        n_classes = int(class_ids.max()) + 1
        log_classes = range(n_classes)
        if names and n_classes > len(names):
            raise DatasetError(
                f"Expected class ids in 0–{len(names) - 1} in the slip log, got "
                f"{n_classes - 1}. Number the classes as in the class table."
            )
    else:
        log_classes = np.unique(labels)
        n_classes = len(log_classes)
        unknown = [name for name in log_classes if name not in names]
        if names and unknown:
            remedy = hint(unknown[0], names) or " Name classes as in the class table."
            raise DatasetError(
                f"Expected classes among {', '.join(names)} in the slip log, got "
                f"{str(unknown[0])!r}.{remedy}"
            )
        class_ids = pd.Index(names or log_classes).get_indexer(labels)
    if n_classes > _MAX_CLASSES:
        raise DatasetError(
            f"Expected at most {_MAX_CLASSES} classes in {path}, got {n_classes}. "
            "Number classes from 0."
        )
    class_names = names or tuple(map(str, log_classes))
    return class_names, torch.from_numpy(class_ids.astype(np.int64))
