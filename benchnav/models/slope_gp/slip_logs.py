"""A robot's own slip logs: a table with a row for each place driven over, CSV, TSV or Parquet.

Columns: `class` (a class's name, or its integer id), `slope_deg` (0–90) and `traversability` (λ, 0–1;
1 minus the slip ratio where the robot holds its commanded speed). Others are ignored, and so are rows
in which slope or traversability is missing.
"""

import hashlib
import re
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from pandas.api.types import is_numeric_dtype
from torch import Tensor

from benchnav.core.errors import DatasetError
from benchnav.core.settings import hint
from benchnav.models.slope_gp.cells import Cells

ENDINGS = (".csv", ".tsv", ".csv.gz", ".tsv.gz", ".parquet")
COLUMNS = ("class", "slope_deg", "traversability")

_LIMITS = {"slope_deg": 90, "traversability": 1}
_MISSING = ["", "NA", "N/A", "nan", "NaN", "null", "None"]
_ENOUGH = 20  # rows of which some would be steeper than 1.6° if slopes were in degrees
_MOST_CLASSES = 256  # class ids are stored in a byte


@dataclass(frozen=True, kw_only=True)
class SlipLogs:
    """What is learned from of a slip log.

    Args:
        class_names: the class table.
        cells: the rows with a slope and a traversability, in order, under the ids of that table.
        digest: SHA-256 of the file.
    """

    class_names: tuple[str, ...]
    cells: Cells
    digest: str


def read_slip_logs(path: str | Path, class_names: tuple[str, ...] = ()) -> SlipLogs:
    """Reads a slip log.

    Args:
        path: a file that ends in one of `ENDINGS`.
        class_names: the class table, into which integer ids of the log are indices. Where none is given it is that of
            the log: its classes in alphabetical order; for integer ids "0", "1", … up to the largest.

    Raises:
        DatasetError: there is no such file, it cannot be read, lacks a column or rows, has a class that the table
            lacks, or a value is no number or out of range.
    """
    path = Path(path)
    rows = _read(path)
    missing = [name for name in COLUMNS if name not in rows]
    if missing:
        raise DatasetError(
            f"Expected columns {', '.join(COLUMNS)} in {path}, got no {' and no '.join(missing)}. "
            f"It has {', '.join(str(name) for name in rows.columns) or 'none'}."
        )
    numbers = {name: _read_numbers(rows[name], name, most, path) for name, most in _LIMITS.items()}
    observed = ~np.logical_or(*(np.isnan(column) for column in numbers.values()))
    if not observed.any():
        raise DatasetError(
            f"Expected rows with a slope and a traversability in {path}, got none among {len(rows)}. "
            "Log places that the robot has driven over."
        )
    steepest = numbers["slope_deg"][observed].max()
    if 0 < steepest <= np.pi / 2 and observed.sum() >= _ENOUGH:
        raise DatasetError(
            f"Expected `slope_deg` in degrees in {path}, got at most {steepest:.4g} in {observed.sum()} rows, as of "
            "radians. Multiply radians by 57.2958. Ground that level in degrees looks the same: log steeper too."
        )
    class_names, class_id = _read_classes(rows["class"], observed, path, class_names)
    slope, value = (torch.from_numpy(column[observed].astype(np.float32)) for column in numbers.values())
    return SlipLogs(
        class_names=class_names,
        cells=Cells(class_id=class_id, slope_deg=slope, traversability=value),
        digest=hashlib.sha256(path.read_bytes()).hexdigest(),
    )


def _read(path: Path) -> pd.DataFrame:
    try:
        if path.suffix == ".parquet":
            return pd.read_parquet(path)
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            # As text: a class may be called NA, and a bad number is to be found in its row.
            rows = pd.read_csv(
                path,
                sep="\t" if ".tsv" in path.suffixes else ",",
                dtype=str,
                keep_default_na=False,
                skipinitialspace=True,
                index_col=False,
            )
        return rows.rename(columns=str.strip)
    except (OSError, EOFError, ValueError, zlib.error, pd.errors.ParserWarning) as error:
        why = [*str(error).strip().splitlines(), type(error).__name__]
        raise DatasetError(
            f"Expected a {path.suffix.removeprefix('.').upper()} table in {path}, got one that cannot be read: {why[0]}"
        ) from error


def _read_numbers(column: pd.Series, name: str, most: float, path: Path) -> np.ndarray:
    """Gives the numbers of a column, float64, NaN where missing."""
    text = column if is_numeric_dtype(column) else column.astype("string").str.strip()
    values = pd.to_numeric(text, errors="coerce").to_numpy(np.float64, na_value=np.nan)
    given = (text.notna() & ~text.isin(_MISSING)).to_numpy(bool)
    bad = np.flatnonzero(given & ~((values >= 0) & (values <= most)))
    if len(bad):
        raise DatasetError(
            f"Expected `{name}` to be numbers within [0, {most}] in {path}, got {column.iloc[bad[0]]!s} in row "
            f"{bad[0] + 1} below the header. Mend that row, or leave the value out."
        )
    return values


def _read_classes(
    column: pd.Series, observed: np.ndarray, path: Path, names: tuple[str, ...]
) -> tuple[tuple[str, ...], Tensor]:
    """Gives the class table, that of the log where it has no names yet, and the id of each observed row."""
    text = column.astype("string").str.strip().fillna("").to_numpy(str)
    absent = np.flatnonzero(observed & (text == ""))
    if len(absent):
        raise DatasetError(
            f"Expected a `class` in every row of {path}, got none in row {absent[0] + 1} below the header."
        )
    found = text[observed]
    # pandas writes ids so where some are missing: 0.0
    if all(re.fullmatch(r"\d+(\.\d*)?", name, re.ASCII) for name in found):
        if broken := [name for name in found if float(name) % 1]:
            raise DatasetError(
                f"Expected class ids as whole numbers in {path}, got {broken[0]}. Number or name the classes."
            )
        ids = np.array([int(name.partition(".")[0]) for name in found])
        own: Any = range(int(ids.max()) + 1)
        if names and len(own) > len(names):
            raise DatasetError(
                f"Expected class ids in 0–{len(names) - 1} in the slip log, got {ids.max()}. "
                "Number the classes as in the class table."
            )
    else:
        own = np.unique(found)
        if names and (others := [name for name in own if name not in names]):
            near = hint(others[0], names) or " Name classes as in the class table."
            raise DatasetError(
                f"Expected classes among {', '.join(names)} in the slip log, got {str(others[0])!r}.{near}"
            )
        ids = pd.Index(names or own).get_indexer(found)
    if len(own) > _MOST_CLASSES:
        raise DatasetError(
            f"Expected at most {_MOST_CLASSES} classes in {path}, got {len(own)}. Number classes from 0."
        )
    return names or tuple(map(str, own)), torch.from_numpy(ids.astype(np.int64))
