"""Tables that a robot logged, a row each time: CSV or TSV, packed or not, or Parquet.

Text is read as text, so that a class may be called NA and a bad number is found in its
row.
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
_SEPARATE = (
    "Separate columns by commas, in a .tsv by tabs, and write decimals with a point."
)
_MISSING = ["", "NA", "N/A", "nan", "NaN", "null", "None"]


def require_columns(
    rows: pd.DataFrame, columns: Collection[str], path: Path, remedy: str = ""
) -> None:
    """Require columns of a log.

    Args:
        rows: of the log.
        columns: that are required.
        path: of the log.
        remedy: what helps where the name of no other column is near, a sentence.

    Raises:
        DatasetError: If one is missing.
    """
    names = [str(name) for name in rows.columns]
    if missing := [name for name in columns if name not in names]:
        near = hint(missing[0], [name for name in names if name not in columns])
        near = near or (remedy and f" {remedy}")
        if len(names) == 1 and any(separator in names[0] for separator in ",;\t| "):
            near = f" {_SEPARATE}"
        elif any(_is_number(name) for name in names):
            near = " Begin the file with a line of column names."
        raise DatasetError(
            f"Expected columns {', '.join(columns)} in {path}, got no "
            f"{' and no '.join(missing)}. "
            f"It has {', '.join(names) or 'none'}.{near}"
        )


def _is_number(text: str) -> bool:
    try:
        return np.isfinite(float(text))
    except ValueError:
        return False


def read_log(path: Path) -> pd.DataFrame:
    """Read a log, a file that ends in one of `ENDINGS`.

    Raises:
        DatasetError: If there is no such file, or it cannot be read.
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
        why = [*str(error).strip().splitlines(), type(error).__name__]
        is_text = isinstance(error, pd.errors.ParserWarning | pd.errors.ParserError)
        remedy = (
            f". {_SEPARATE} Remove lines above the column names." if is_text else ""
        )
        if isinstance(error, UnicodeDecodeError):
            remedy = ". Save it as UTF-8."
        elif isinstance(error, pd.errors.EmptyDataError):
            remedy = ". Write a line of column names and a row for each time."
        raise DatasetError(
            f"Expected a {path.suffix.removeprefix('.').upper()} table in {path}, got "
            "one that cannot be read: "
            f"{why[0].removesuffix('.')}{remedy}"
        ) from error
    for name in rows.columns:
        # pandas numbers the second of two columns of one name
        first, dot, number = str(name).rpartition(".")
        if dot and number.isdigit() and first in rows.columns and not _is_number(first):
            raise DatasetError(
                f"Expected one column `{first}` in {path}, got several. Rename or "
                "remove the others."
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
    """Return the numbers of a column, float64, NaN where missing, shape [N].

    Args:
        rows: of a log.
        name: of the column.
        path: of the log.
        limits: minimum and maximum.
        remedy: what helps where all numbers are beyond the limits, a sentence.
        number: what helps where no value is a number, a sentence.

    Raises:
        DatasetError: If a value is no finite number, or beyond the limits.
    """
    column, (minimum, maximum) = rows[name], limits
    text = column if is_numeric_dtype(column) else column.astype("string").str.strip()
    values = pd.to_numeric(text, errors="coerce").to_numpy(np.float64, na_value=np.nan)
    is_given = (text.notna() & ~text.isin(_MISSING)).to_numpy(bool)
    is_number = np.isfinite(values)
    is_within = (values >= minimum) & (values <= maximum)
    for expected, is_good, everywhere in (
        ("to be numbers", is_number, number),
        (
            f"within [{minimum:g}, {maximum:g}]",
            ~is_number | is_within,
            remedy or "Convert the column.",
        ),
    ):
        bad = np.flatnonzero(is_given & ~is_good)
        if len(bad):
            is_everywhere = len(bad) == is_given.sum()
            raise DatasetError(
                f"Expected `{name}` {expected} in {path}, got {column.iloc[bad[0]]!s} "
                f"in row {bad[0] + 1} below the "
                f"header. {everywhere if is_everywhere else 'Mend that row, or leave the value out.'}"
            )
    return values


def read_names(rows: pd.DataFrame, name: str, path: Path) -> np.ndarray:
    """Return the names of a column, such as those of classes or drives, as text, shape
    [N].

    Raises:
        DatasetError: If a row has none.
    """
    text = rows[name].astype("string").str.strip().fillna("")
    absent = text.index[text == ""]
    if len(absent):
        raise DatasetError(
            f"Expected a `{name}` in every row of {path}, got none in row "
            f"{absent[0] + 1} below the header. "
            "Fill it in, or leave the row out."
        )
    return text.to_numpy(str)
