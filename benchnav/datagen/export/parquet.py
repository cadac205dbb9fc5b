"""Maps as rows of Parquet files, with a column for each field.

Arrays are nested lists of fixed size. The values are those of the dataset, bit for bit;
NaN is stored as NaN, and no value is null. The first column, `map`, is the index of the
map in its split. Letters in shapes: B maps.
"""

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.core.errors import DatasetError
from benchnav.datagen import schema
from benchnav.datagen.files.reader import TerrainDataset

MAP = "map"
FOLDER = "data"
CELLS_PER_FILE = 2**25
_CELLS_PER_ROW_GROUP = 2**20


def split_names(splits: Iterable[str]) -> dict[str, str]:
    """Return the name of each split in file names, such as `test_std` for `test/std`.

    The names consist of letters, digits and `_`.

    Raises:
        DatasetError: If two splits have the same file name.
    """
    names = {}
    for split in splits:
        names[split] = re.sub(r"\W", "_", split, flags=re.ASCII)
    for split, name in names.items():
        same = [candidate for candidate in names if names[candidate] == name]
        if len(same) > 1:
            raise DatasetError(
                "Expected names of splits that differ in letters or digits, got "
                f"{' and '.join(same)}, whose files would all be named {name!r}. "
                f"Export these splits separately, for example with `splits` [{split}]."
            )
    return names


def columns_of(
    dataset: TerrainDataset, fields: Iterable[str]
) -> dict[str, schema.Field]:
    """Return the columns of a split by name: the index of the map, and `fields`."""
    meaning = "number of the map in its split"
    columns = {MAP: schema.Field("<i8", (), "1", 0, np.inf, meaning)}
    for name in fields:
        columns[name] = dataset.fields[name]
    return columns


def table_schema(
    dataset: TerrainDataset, split: str, fields: Sequence[str]
) -> pa.Schema:
    """Return the schema of a split's table.

    Its metadata contain shape, unit and meaning of each column, and the dataset's
    recipes.

    Args:
        dataset: dataset of the split.
        split: name of the split.
        fields: names of fields, in the order of the columns.
    """
    manifest = dataset.manifest
    entry = dataset.splits[split]
    metadata = {
        "format": schema.FORMAT,
        "id": dataset.id,
        "generator": manifest["generator"],
        "grid": asdict(dataset.grid),
        "split": split,
        **{key: entry[key] for key in ("scenario", "maps", "digest")},
        "truth": dataset.truth_of(split),
        "parts": entry["parts"],
        "recipes": manifest["recipes"],
    }
    columns = []
    for name, field in columns_of(dataset, fields).items():
        shape = field.entry_shape(*dataset.grid.shape)
        kind = pa.from_numpy_dtype(np.dtype(field.dtype))
        for size in reversed(shape):
            element = pa.field("element", kind, False)
            kind = pa.list_(element, size)
        column_metadata = {
            "shape": json.dumps(list(shape)),
            "unit": field.unit,
            "meaning": field.meaning,
        }
        columns.append(pa.field(name, kind, False, column_metadata))
    return pa.schema(columns, {"benchnav": json.dumps(metadata)})


def write_split(
    folder: Path,
    name: str,
    dataset: TerrainDataset,
    split: str,
    fields: Sequence[str],
    maps_per_file: int,
) -> Iterator[int]:
    """Write a split to one or more files, in chunks.

    Args:
        folder: folder of the files.
        name: name of the split in file names, from `split_names`.
        dataset: dataset of the split.
        split: name of the split in the dataset.
        fields: names of fields, in the order of the columns.
        maps_per_file: maximum number of maps in a file; if 0, `CELLS_PER_FILE` limits
            the number.

    Yields:
        Number of maps written in each chunk.
    """
    maximum = maps_per_file or dataset.grid.maps_in(CELLS_PER_FILE)
    step = dataset.grid.maps_in(_CELLS_PER_ROW_GROUP)
    n_maps = dataset.map_count(split)
    columns = table_schema(dataset, split, fields)
    n_files = -(-n_maps // maximum)
    for number in range(n_files):
        first = number * maximum
        end = min(first + maximum, n_maps)
        path = folder / f"{name}-{number:05d}-of-{n_files:05d}.parquet"
        with pq.ParquetWriter(path, columns, compression="zstd") as writer:
            for start in range(first, end, step):
                indices = range(start, min(start + step, end))
                maps = dataset.read(split, indices, fields)
                maps[MAP] = np.array(indices)
                arrays = [
                    _nested_array(maps[column.name], column.type) for column in columns
                ]
                batch = pa.RecordBatch.from_arrays(arrays, schema=columns)
                writer.write_batch(batch)
                yield len(indices)


def _nested_array(values: np.ndarray, kind: pa.DataType) -> pa.Array:
    """Return values of shape [B, *entry shape] as nested lists of a Parquet type."""
    if not pa.types.is_fixed_size_list(kind):
        return pa.array(np.ascontiguousarray(values))
    elements = values.reshape(-1, *values.shape[2:])
    inner = _nested_array(elements, kind.value_type)
    return pa.FixedSizeListArray.from_arrays(inner, type=kind)
