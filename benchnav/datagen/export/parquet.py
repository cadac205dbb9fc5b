"""Maps as rows of Parquet files: a column a field, arrays as nested lists of fixed size.

Any reader of Parquet takes them. The values are those of the dataset, bit for bit; NaN stays NaN and nothing is
null. The first column, `map`, is the number of the map in its split. Letters in shapes: B maps.
"""

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.core.errors import DatasetError
from benchnav.datagen import schema
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import Maps

MAP = "map"
FOLDER = "data"
CELLS_A_FILE = 2**25
_CELLS_A_ROW_GROUP = 2**20


def split_names(splits: Iterable[str]) -> dict[str, str]:
    """Gives splits names that readers allow, of letters, digits and `_`: `test/std` is `test_std`.

    Raises:
        DatasetError: two of them would have one name.
    """
    names = {split: re.sub(r"\W", "_", split, flags=re.ASCII) for split in splits}
    for split, name in names.items():
        alike = [other for other in names if names[other] == name]
        if len(alike) > 1:
            raise DatasetError(
                f"Expected splits that differ in letters and digits, got {' and '.join(alike)}, both {name!r} "
                f"in Parquet. Export them apart, with `splits` [{split}]."
            )
    return names


def table_schema(dataset: TerrainDataset, split: str, fields: Sequence[str]) -> pa.Schema:
    """The columns of a split, with shape, unit and meaning of each, and the dataset's recipes, as metadata.

    Args:
        dataset: where the split is.
        split: its name there.
        fields: which fields, in the order of the columns.
    """
    manifest = dataset.manifest
    about = {
        "format": schema.FORMAT,
        "id": dataset.id,
        "generator": manifest["generator"],
        "grid": asdict(dataset.grid),
        "split": split,
        "scenario": dataset.splits[split]["scenario"],
        "maps": dataset.map_count(split),
        "digest": dataset.splits[split]["digest"],
        "truth": dataset.truth_of(split),
        "parts": dataset.splits[split]["parts"],
        "recipes": manifest["recipes"],
    }
    number = _column(MAP, pa.int64(), [], "1", "number of the map in its split")
    columns = []
    for name in fields:
        field = dataset.fields[name]
        shape = field.entry_shape(*dataset.grid.shape)
        columns.append(_column(name, _nested_type(field.dtype, shape), shape, field.unit, field.meaning))
    return pa.schema([number, *columns], {"benchnav": json.dumps(about)})


def write_split(
    folder: Path, name: str, dataset: TerrainDataset, split: str, fields: Sequence[str], maps_a_file: int
) -> Iterator[int]:
    """Writes a split as one file or several, some maps at a time.

    Args:
        folder: where to.
        name: of the split, as files are called.
        dataset: where the split is.
        split: its name there.
        fields: which fields, in the order of the columns.
        maps_a_file: most maps of a file; 0 for as many as `CELLS_A_FILE` allow.

    Yields:
        How many maps were written in each step.
    """
    count, (height, width) = dataset.map_count(split), dataset.grid.shape
    most = maps_a_file or max(1, CELLS_A_FILE // (height * width))
    files = -(-count // most)
    columns = table_schema(dataset, split, fields)
    with ExitStack() as opened:
        for indices, maps in dataset.chunks(split, fields, _CELLS_A_ROW_GROUP):
            for first in _cut(indices, most):
                rows = range(first, min(indices.stop, (first // most + 1) * most))
                if first % most == 0:
                    opened.close()
                    path = folder / f"{name}-{first // most:05d}-of-{files:05d}.parquet"
                    writer = opened.enter_context(pq.ParquetWriter(path, columns, compression="zstd"))
                within = slice(rows.start - indices.start, rows.stop - indices.start)
                part = {field: values[within] for field, values in maps.items()}
                writer.write_batch(_batch(rows, part, columns))
                yield len(rows)


def _cut(indices: range, most: int) -> Iterator[int]:
    """Where rows of some maps begin that go to one file each."""
    yield indices.start
    yield from range((indices.start // most + 1) * most, indices.stop, most)


def _column(name: str, kind: pa.DataType, shape: Sequence[int], unit: str, meaning: str) -> pa.Field:
    return pa.field(name, kind, False, {"shape": json.dumps(list(shape)), "unit": unit, "meaning": meaning})


def _nested_type(dtype: str, shape: Sequence[int]) -> pa.DataType:
    kind = pa.from_numpy_dtype(np.dtype(dtype))
    for size in reversed(shape):
        kind = pa.list_(pa.field("element", kind, False), size)
    return kind


def _batch(rows: range, maps: Maps, columns: pa.Schema) -> pa.RecordBatch:
    arrays = [pa.array(np.arange(rows.start, rows.stop))]
    for column in list(columns)[1:]:
        arrays.append(_nested_array(maps[column.name], column.type))
    return pa.RecordBatch.from_arrays(arrays, schema=columns)


def _nested_array(values: np.ndarray, kind: pa.DataType) -> pa.Array:
    """Lists within lists, of values of shape [B, *entry shape]."""
    kinds = [kind]
    while pa.types.is_fixed_size_list(kinds[-1]):
        kinds.append(kinds[-1].value_type)
    array = pa.array(np.ascontiguousarray(values).reshape(-1))
    for nested in reversed(kinds[:-1]):
        array = pa.FixedSizeListArray.from_arrays(array, type=nested)
    return array
