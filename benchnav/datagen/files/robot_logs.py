"""Reader of tables that robots logged: CSV, TSV (also .gz), or Parquet.

A table has a row for each time. Values of text files are read as text. A class may
therefore be named NA, and an error on an invalid number names the row.
"""

import warnings
import zlib
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pandas as pd
from pandas.api.types import is_numeric_dtype

from benchnav.core.errors import DatasetError
from benchnav.core.settings import hint
from benchnav.core.touched import note_file

ENDINGS = (".csv", ".tsv", ".csv.gz", ".tsv.gz", ".parquet")
_SEPARATOR_REMEDY = (
    "Separate columns by commas, in a .tsv by tabs, and write decimals with a point."
)
_MISSING = ["", "NA", "N/A", "nan", "NaN", "null", "None"]


def require_columns(
    rows: pd.DataFrame, columns: Collection[str], path: Path, remedy: str = ""
) -> None:
    """Check that a log has all required columns.

    Args:
        rows: rows of the log.
        columns: required columns.
        path: path of the log.
        remedy: remedy if no column has a similar name, one sentence.

    Raises:
        DatasetError: If a column is missing.
    """
    names = [str(name) for name in rows.columns]
    if missing := [name for name in columns if name not in names]:
        advice = hint(missing[0], [name for name in names if name not in columns])
        advice = advice or (remedy and f" {remedy}")
        if len(names) == 1 and any(separator in names[0] for separator in ",;\t| "):
            advice = f" {_SEPARATOR_REMEDY}"
        elif any(_is_number(name) for name in names):
            advice = " Begin the file with a line of column names."
        raise DatasetError(
            f"Expected columns {', '.join(columns)} in {path}, got no "
            f"{' and no '.join(missing)}. The file has "
            f"{', '.join(names) or 'no columns'}."
            f"{advice}"
        )


def _is_number(text: str) -> bool:
    try:
        return np.isfinite(float(text))
    except ValueError:
        return False


def read_log(path: Path) -> pd.DataFrame:
    """Return the rows of a log, a file whose name ends in one of `ENDINGS`.

    Raises:
        DatasetError: If the file does not exist or cannot be read.
    """
    try:
        if path.suffix == ".parquet":
            note_file(path)
            return pd.read_parquet(path).reset_index(drop=True)
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            rows = pd.read_csv(
                path,
                sep="\t" if ".tsv" in path.suffixes else ",",
                dtype=str,
                keep_default_na=False,
                skipinitialspace=True,
                index_col=False,
            )
        rows = rows.rename(columns=str.strip)
    except (
        OSError,
        EOFError,
        ValueError,
        zlib.error,
        pd.errors.ParserWarning,
    ) as error:
        lines = [*str(error).strip().splitlines(), type(error).__name__]
        remedy = ""
        if isinstance(error, pd.errors.ParserWarning | pd.errors.ParserError):
            remedy = f". {_SEPARATOR_REMEDY} Remove lines above the column names."
        elif isinstance(error, UnicodeDecodeError):
            remedy = ". Save it as UTF-8."
        elif isinstance(error, pd.errors.EmptyDataError):
            remedy = ". Write a line of column names and a row for each time."
        kind = path.suffix.removeprefix(".").upper()
        raise DatasetError(
            f"Expected a {kind} table in {path}, got a file that cannot be read: "
            f"{lines[0].removesuffix('.')}{remedy}"
        ) from error
    for name in rows.columns:
        # pandas adds a number to the name of a repeated column, such as `x.1`.
        first, dot, number = str(name).rpartition(".")
        if dot and number.isdigit() and first in rows.columns and not _is_number(first):
            raise DatasetError(
                f"Expected one column `{first}` in {path}, got several. Rename or "
                "remove the other columns."
            )
    return rows


def read_numbers(
    rows: pd.DataFrame,
    name: str,
    path: Path,
    limits: tuple[float, float],
    remedy: str = "",
    number: str = "Convert the column to numbers.",
) -> np.ndarray:
    """Return the numbers of a column, float64, NaN if missing, shape [N].

    Args:
        rows: rows of a log.
        name: name of the column.
        path: path of the log.
        limits: minimum and maximum, inclusive.
        remedy: remedy if all numbers are outside the limits, one sentence.
        number: remedy if no value is a number, one sentence.

    Raises:
        DatasetError: If a value is not a finite number, or is outside the limits.
    """
    column, (minimum, maximum) = rows[name], limits
    text = column if is_numeric_dtype(column) else column.astype("string").str.strip()
    values = pd.to_numeric(text, errors="coerce").to_numpy(np.float64, na_value=np.nan)
    is_present = (text.notna() & ~text.isin(_MISSING)).to_numpy(bool)
    is_number = np.isfinite(values)
    is_within = (values >= minimum) & (values <= maximum)
    expected_range = f"within [{minimum:g}, {maximum:g}]"
    remedy = remedy or "Convert the column."
    for expected, is_valid, advice in (
        ("to be numbers", is_number, number),
        (expected_range, ~is_number | is_within, remedy),
    ):
        invalid = np.flatnonzero(is_present & ~is_valid)
        if len(invalid):
            if len(invalid) < is_present.sum():
                advice = "Correct that row, or leave the value out."
            row = invalid[0]
            raise DatasetError(
                f"Expected `{name}` {expected} in {path}, got {column.iloc[row]!s} in "
                f"row {row + 1} below the header. {advice}"
            )
    return values


def read_names(rows: pd.DataFrame, name: str, path: Path) -> np.ndarray:
    """Return the names in a column, such as those of classes or drives, shape [N].

    Raises:
        DatasetError: If a row has no name.
    """
    text = rows[name].astype("string").str.strip().fillna("")
    absent = text.index[text == ""]
    if len(absent):
        raise DatasetError(
            f"Expected a value of `{name}` in each row of {path}, got an empty value "
            f"in row {absent[0] + 1} below the header. Fill it in, or leave the row "
            "out."
        )
    return text.to_numpy(str)
