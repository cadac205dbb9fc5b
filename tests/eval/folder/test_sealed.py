"""Files of a run hold digests of their table and of what they say of themselves."""

import random
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from benchnav.eval.folder.sealed import (
    DamageError,
    content_digest,
    metadata,
    read_sealed,
    with_metadata,
)

TABLE = pa.table(
    {
        "x_m": np.array([0.5, np.nan, -0.0], np.float32),
        "map": np.array([0, 1, 2], np.int32),
        "success": [True, False, True],
        "error": ["", "fault", "–"],
        "score": [0.25, None, 0.5],
    }
)


def same(table: pa.Table) -> bool:
    return bool(table.to_pandas().equals(TABLE.to_pandas()))


def test_every_bit_counts_or_makes_no_difference(tmp_path: Path) -> None:
    path = tmp_path / "unit.parquet"
    pq.write_table(with_metadata(TABLE, {"key": "k", "code": {"torch": "2.1"}}), path)
    content, about = path.read_bytes(), metadata(path)
    assert same(read_sealed(path))
    assert about["key"] == "k"
    chance = random.Random(0)
    damaged = 0
    for place in range(len(content)):
        changed = bytearray(content)
        changed[place] ^= 1 << chance.randrange(8)
        path.write_bytes(bytes(changed))
        assert metadata(path) in ({}, about)
        try:
            assert same(read_sealed(path)), f"byte {place}"
        except DamageError:
            damaged += 1
    assert damaged > 0.4 * len(content)


@pytest.mark.parametrize(
    "other",
    [
        TABLE.set_column(
            0, "x_m", pa.array([0.5, np.nan, 0.0], pa.float32())
        ),  # the sign of zero
        TABLE.set_column(0, "x_m", pa.array([0.5, np.nan, -0.0], pa.float64())),
        TABLE.rename_columns(["y_m", *TABLE.column_names[1:]]),
        TABLE.set_column(3, "error", pa.array(["f", "ault", "–"])),
        TABLE.set_column(4, "score", pa.array([0.25, 0.5, None])),
        TABLE.slice(0, 2),
        TABLE.drop_columns(["success"]),
    ],
)
def test_another_table_has_another_digest(other: pa.Table) -> None:
    assert content_digest(other) != content_digest(TABLE)


def test_the_order_of_columns_and_those_without_a_value_do_not_count() -> None:
    """As when steps get the columns of another robot's actions."""
    missing = pa.array(np.full(3, np.nan, np.float32))
    wider = TABLE.select(TABLE.column_names[::-1]).append_column(
        "steering_rad", missing
    )
    assert content_digest(wider) == content_digest(TABLE)


def test_files_without_a_digest_are_damaged(tmp_path: Path) -> None:
    path = tmp_path / "unit.parquet"
    for table in (TABLE.replace_schema_metadata({b"benchnav": b'{"key": "k"}'}), TABLE):
        pq.write_table(table, path)
        assert metadata(path) == {}
        with pytest.raises(DamageError):
            read_sealed(path)
