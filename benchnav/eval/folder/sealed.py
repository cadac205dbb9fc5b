"""Parquet files of a run with digests of their contents, so that changes are detected.

The metadata of a file is JSON text that contains its own digest, as in `run.json`
(see `benchnav.core.store.seal`). The metadata include `content`, the digest of the table.
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

METADATA = b"benchnav"  # key of benchnav's metadata in a Parquet file
CONTENT = "content"


class DamageError(ValueError):
    """A file of a run is missing, unreadable or changed."""


def content_digest(table: pa.Table) -> str:
    """Return the SHA-256 of a table's columns: names, types and values.

    The order of columns does not matter. Columns without any value are ignored: files
    of steps receive such columns when a run is extended by a robot with different
    action dimensions.

    Args:
        table: a table of numbers, Booleans and text.
    """
    digest = hashlib.sha256()
    for name in sorted(table.column_names):
        column = table[name].combine_chunks()
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
            kind = "text"
            values = json.dumps(column.to_pylist()).encode()
            is_missing = column.null_count == len(column)
        else:
            array = column.to_numpy(zero_copy_only=False)
            kind = str(array.dtype)
            values = array.tobytes()
            is_missing = array.dtype.kind in "fO" and bool(np.all(array != array))
        if not is_missing:
            digest.update(json.dumps([name, kind, len(values)]).encode() + values)
    return digest.hexdigest()


def with_metadata(table: pa.Table, file_metadata: Mapping[str, Any]) -> pa.Table:
    """Return a table with metadata and the digest of its content; see `metadata`."""
    text = seal({**file_metadata, CONTENT: content_digest(table)})
    return table.replace_schema_metadata({METADATA: text.encode()})


def metadata(path: Path) -> dict[str, Any]:
    """Return a file's metadata; empty if they are missing, damaged or not benchnav's."""
    try:
        return _unsealed((pq.read_schema(path).metadata or {}).get(METADATA, b"{}"))
    except Exception:  # with a flipped bit, Arrow may raise any error
        return {}


def _unsealed(text: bytes) -> dict[str, Any]:
    content = json.loads(text)
    if not isinstance(content, dict):
        raise DamageError("its metadata is not a JSON object")
    return unseal(text) if content else {}


def read_sealed(path: Path) -> pa.Table:
    """Read the table of a file, and check its digest.

    Args:
        path: file of a unit or of steps.

    Returns:
        The table without metadata.

    Raises:
        DamageError: If the file cannot be read, or differs from what was written.
    """
    try:
        table = pq.read_table(path, partitioning=None)
        file_metadata = _unsealed((table.schema.metadata or {}).get(METADATA, b"{}"))
        content = content_digest(table)
    except FileNotFoundError:
        raise DamageError("it is missing") from None
    except PermissionError:
        raise
    except (DamageError, ConfigError):
        raise
    except Exception as error:
        raise DamageError(f"it cannot be read ({type(error).__name__})") from error
    if not file_metadata or file_metadata.get(CONTENT) != content:
        raise DamageError("it was changed after benchnav wrote it")
    return table.replace_schema_metadata(None)


def damage_of(path: Path, name: str) -> list[str]:
    """Return a line with a file's name and damage; empty if it is intact."""
    try:
        read_sealed(path)
    except DamageError as error:
        return [f"{name}: {error}"]
    return []
