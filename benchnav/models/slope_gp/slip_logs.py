"""A robot's own slip logs, what the class-wise GPs learn from beside maps.

They are tables with a row for each place driven over, CSV, TSV or Parquet. Columns:
`class` (a class's name, or its integer id), `slope_deg` (0–90) and `traversability` (λ,
0–1; 1 minus the slip ratio where the robot holds its commanded speed), and perhaps
`drive` (its name). Others are ignored, and so are rows in which slope or traversability
is missing.
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
_ENOUGH = 20  # rows of which some would be steeper than 1.6° if slopes were in degrees
_MOST_CLASSES = 256  # class ids are stored in a byte


class SlipLogs(NamedTuple):
    """What is learned from of a slip log.

    Args:
        class_names: the class table.
        cells: the rows with a slope and a traversability, in order, under the ids of
            that table.
        digest: SHA-256 of the file.
        drive: number of the drive of each of these rows, int64, shape [N]; None where
            the log does not tell drives.
    """

    class_names: tuple[str, ...]
    cells: Cells
    digest: str
    drive: Tensor | None


def read_slip_logs(path: str | Path, class_names: tuple[str, ...] = ()) -> SlipLogs:
    """Reads a slip log.

    Args:
        path: a file that ends in one of `ENDINGS`.
        class_names: the class table, into which integer ids of the log are indices.
            Where none is given it is that of
            the log: its classes in alphabetical order; for integer ids "0", "1", … up
                to the largest.

    Raises:
        DatasetError: there is no such file, it cannot be read, lacks a column or rows,
            has a class that the table lacks, or a value is no number or out of range.
    """
    path = Path(path)
    rows = read_log(path)
    require_columns(rows, COLUMNS, path)
    for name, limits in _LIMITS.items():
        rows[name] = read_numbers(rows, name, path, limits)
    observed = rows.dropna(subset=list(_LIMITS))
    if observed.empty:
        raise DatasetError(
            f"Expected rows with a slope and a traversability in {path}, got none "
            f"among {len(rows)}. "
            "Log places that the robot has driven over."
        )
    steepest = observed["slope_deg"].max()
    if 0 < steepest <= np.pi / 2 and len(observed) >= _ENOUGH:
        raise DatasetError(
            f"Expected `slope_deg` in degrees in {path}, got at most {steepest:.4g} "
            f"in {len(observed)} rows, as of "
            "radians. Multiply radians by 57.2958. Ground that level in degrees looks "
            "the same: log steeper too."
        )
    class_names, class_id = _read_classes(observed, path, class_names)
    slope, value = (
        torch.from_numpy(observed[name].to_numpy(np.float32)) for name in _LIMITS
    )
    cells = Cells(class_id=class_id, slope_deg=slope, traversability=value)
    drive = None
    if "drive" in observed:
        drive = torch.from_numpy(
            np.unique(read_names(observed, "drive", path), return_inverse=True)[1]
        )
    return SlipLogs(
        class_names, cells, hashlib.sha256(path.read_bytes()).hexdigest(), drive
    )


def _read_classes(
    rows: pd.DataFrame, path: Path, names: tuple[str, ...]
) -> tuple[tuple[str, ...], Tensor]:
    """Gives the class table, that of the log where it has no names yet, and the id of
    each row.
    """
    found = read_names(rows, "class", path)
    # pandas writes ids so where some are missing: 0.0
    if all(re.fullmatch(r"\d+(\.\d*)?", name, re.ASCII) for name in found):
        ids = found.astype(float)
        if len(broken := found[ids % 1 > 0]):
            raise DatasetError(
                f"Expected class ids as whole numbers in {path}, got {broken[0]}. "
                "Number or name the classes."
            )
        count = int(ids.max()) + 1
        own: Any = range(count)
        if names and count > len(names):
            raise DatasetError(
                f"Expected class ids in 0–{len(names) - 1} in the slip log, got "
                f"{count - 1}. "
                "Number the classes as in the class table."
            )
    else:
        own = np.unique(found)
        count = len(own)
        if names and (others := [name for name in own if name not in names]):
            near = hint(others[0], names) or " Name classes as in the class table."
            raise DatasetError(
                f"Expected classes among {', '.join(names)} in the slip log, got "
                f"{str(others[0])!r}.{near}"
            )
        ids = pd.Index(names or own).get_indexer(found)
    if count > _MOST_CLASSES:
        raise DatasetError(
            f"Expected at most {_MOST_CLASSES} classes in {path}, got {count}. Number "
            "classes from 0."
        )
    return names or tuple(map(str, own)), torch.from_numpy(ids.astype(np.int64))
