"""Maps as rows of Parquet files: a column a field, arrays as nested lists of fixed
size.

Any reader of Parquet takes them. The values are those of the dataset, bit for bit; NaN
stays NaN and nothing is null. The first column, `map`, is the number of the map in its
split. Letters in shapes: B maps.
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
CELLS_A_FILE = 2**25
_CELLS_A_ROW_GROUP = 2**20


def split_names(splits: Iterable[str]) -> dict[str, str]:
    """Gives splits names that readers allow, of letters, digits and `_`: `test/std` is
    `test_std`.

    Raises:
        DatasetError: two of them would have one name.
    """
    names = {split: re.sub(r"\W", "_", split, flags=re.ASCII) for split in splits}
    for split, name in names.items():
        alike = [other for other in names if names[other] == name]
        if len(alike) > 1:
            raise DatasetError(
                "Expected splits that differ in letters and digits, got "
                f"{' and '.join(alike)}, both {name!r} "
                f"in Parquet. Export them apart, with `splits` [{split}]."
            )
    return names


def columns_of(
    dataset: TerrainDataset, fields: Iterable[str]
) -> dict[str, schema.Field]:
    """The columns of a split: the number of the map, and some of the dataset's fields."""
    columns = {
        MAP: schema.Field("<i8", (), "1", 0, np.inf, "number of the map in its split")
    }
    return columns | {name: dataset.fields[name] for name in fields}


def table_schema(
    dataset: TerrainDataset, split: str, fields: Sequence[str]
) -> pa.Schema:
    """The columns of a split, with shape, unit and meaning of each, and the dataset's
    recipes, as metadata.

    Args:
        dataset: where the split is.
        split: its name there.
        fields: which fields, in the order of the columns.
    """
    manifest, entry = dataset.manifest, dataset.splits[split]
    about = {
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
        kind, shape = (
            pa.from_numpy_dtype(np.dtype(field.dtype)),
            field.entry_shape(*dataset.grid.shape),
        )
        for size in reversed(shape):
            kind = pa.list_(pa.field("element", kind, False), size)
        words = {
            "shape": json.dumps(list(shape)),
            "unit": field.unit,
            "meaning": field.meaning,
        }
        columns.append(pa.field(name, kind, False, words))
    return pa.schema(columns, {"benchnav": json.dumps(about)})


def write_split(
    folder: Path,
    name: str,
    dataset: TerrainDataset,
    split: str,
    fields: Sequence[str],
    maps_a_file: int,
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
    most = maps_a_file or dataset.grid.maps_in(CELLS_A_FILE)
    step = dataset.grid.maps_in(_CELLS_A_ROW_GROUP)
    every, columns = (
        range(dataset.map_count(split)),
        table_schema(dataset, split, fields),
    )
    files = -(-len(every) // most)
    for number in range(files):
        own = every[number * most :][:most]
        path = folder / f"{name}-{number:05d}-of-{files:05d}.parquet"
        with pq.ParquetWriter(path, columns, compression="zstd") as writer:
            for place in range(0, len(own), step):
                rows = own[place : place + step]
                maps = {MAP: np.array(rows), **dataset.read(split, rows, fields)}
                arrays = [
                    _nested_array(maps[column.name], column.type) for column in columns
                ]
                writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=columns))
                yield len(rows)


def _nested_array(values: np.ndarray, kind: pa.DataType) -> pa.Array:
    """Lists within lists, of values of shape [B, *entry shape]."""
    if not pa.types.is_fixed_size_list(kind):
        return pa.array(np.ascontiguousarray(values))
    inner = _nested_array(values.reshape(-1, *values.shape[2:]), kind.value_type)
    return pa.FixedSizeListArray.from_arrays(inner, type=kind)
