"""Parquet files of a run that hold digests of what they hold, so that a changed bit is
found.

The metadata of a file is JSON text sealed as `run.json` is
(`benchnav.core.store.seal`). It holds, beside what the file
says of itself, `content`: the digest of the table.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.core.errors import ConfigError
from benchnav.core.store import seal, unseal

METADATA = b"benchnav"  # key of ours in a Parquet file's metadata
CONTENT = "content"


class DamageError(ValueError):
    """A file of a run does not hold what was written to it."""


def content_digest(table: pa.Table) -> str:
    """Return the SHA-256 of a table's columns: names, types and values.

    The order of columns does not count, and neither do columns in which every value is
    missing, since files of steps get such columns when a run is extended by another
    robot.

    Args:
        table: any table of numbers, Booleans and text.
    """
    digest = hashlib.sha256()
    for name in sorted(table.column_names):
        column = table[name].combine_chunks()
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
            kind, values = "text", json.dumps(column.to_pylist()).encode()
            is_missing = column.null_count == len(column)
        else:
            array = column.to_numpy(zero_copy_only=False)
            kind, values = str(array.dtype), array.tobytes()
            is_missing = array.dtype.kind in "fO" and bool(np.all(array != array))
        if not is_missing:
            digest.update(json.dumps([name, kind, len(values)]).encode() + values)
    return digest.hexdigest()


def with_metadata(table: pa.Table, about: Mapping[str, Any]) -> pa.Table:
    """Return a table whose metadata says what it is, with the digest of its content;
    see `metadata`.
    """
    text = seal({**about, CONTENT: content_digest(table)})
    return table.replace_schema_metadata({METADATA: text.encode()})


def metadata(path: Path) -> dict[str, Any]:
    """Return what a file says of itself; empty if it is missing, damaged, or not a file
    of a run.
    """
    try:
        return _unsealed((pq.read_schema(path).metadata or {}).get(METADATA, b"{}"))
    except Exception:  # what a flipped bit makes Arrow raise is not of one kind
        return {}


def _unsealed(text: bytes) -> dict[str, Any]:
    content = json.loads(text)
    if not isinstance(content, dict):
        raise DamageError("its metadata is not a JSON object")
    return unseal(text) if content else {}


def read_sealed(path: Path) -> pa.Table:
    """Read a file and compare it with its digest.

    Args:
        path: a unit or a file of steps.

    Returns:
        The table, without metadata, on which no digest depends.

    Raises:
        DamageError: If it cannot be read, or holds something else than was written to
            it.
    """
    try:
        table = pq.read_table(path, partitioning=None)
        about = _unsealed((table.schema.metadata or {}).get(METADATA, b"{}"))
        content = content_digest(table)
    except FileNotFoundError:
        raise DamageError("it is missing") from None
    except PermissionError:
        raise
    except (DamageError, ConfigError):
        raise
    except Exception as error:
        raise DamageError(f"it cannot be read ({type(error).__name__})") from error
    if not about or about.get(CONTENT) != content:
        raise DamageError("it was changed after benchnav wrote it")
    return table.replace_schema_metadata(None)


def damage_of(path: Path, name: str) -> list[str]:
    """Return a line that begins with the name of a file and says what is wrong with it;
    none where it is as written.
    """
    try:
        read_sealed(path)
    except DamageError as error:
        return [f"{name}: {error}"]
    return []
