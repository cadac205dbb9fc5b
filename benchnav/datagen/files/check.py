"""Complete check of a dataset: schema, checksums, ranges, digests of maps and splits."""

from collections.abc import Collection, Iterator
from contextlib import suppress
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from benchnav.core.errors import DatasetError
from benchnav.datagen import schema
from benchnav.datagen.files.manifest import READ_ERRORS, open_file
from benchnav.datagen.files.reader import CHUNK_CELLS, TerrainDataset

_UNREADABLE = "is missing or cannot be opened"


class Fault(NamedTuple):
    """Fault of a dataset.

    Args:
        split: name of the split.
        map: index of the map; −1 if the fault does not concern a single map.
        field: name of the damaged array; empty if the fault does not concern a single
            array.
        problem: description of the fault.
        file: name of the shard; empty if the dataset is one file.
    """

    split: str
    map: int
    field: str
    problem: str
    file: str = ""

    def __str__(self) -> str:
        """Return a description of the fault in one line."""
        return next(summarise([self]))


def summarise(faults: list[Fault]) -> Iterator[str]:
    """Yield a line for each fault, or for each run of maps with the same fault."""

    def run_of(item: tuple[int, Fault]) -> Fault:
        position, fault = item
        return fault._replace(map=fault.map - position)

    ordered = sorted(faults, key=attrgetter("split", "field", "problem", "file", "map"))
    for _, items in groupby(enumerate(ordered), run_of):
        (_, first), *others = items
        maps = f"map {first.map}" if first.map >= 0 else ""
        if others:
            maps = f"maps {first.map}–{first.map + len(others)}"
        field = f"field {first.field!r} " if first.field else ""
        file = f" ({first.file})" if first.file else ""
        parts = (first.split, maps, f"{field}{first.problem}")
        yield ": ".join(filter(None, parts)) + file


def find_faults(path: str | Path) -> list[Fault]:
    """Read all data of a dataset and return its faults.

    Args:
        path: path of the dataset's file or folder.

    Returns:
        All faults, with each damaged map and field; empty if the dataset is undamaged.

    Raises:
        DatasetError: If the file or its manifest cannot be read.
    """
    dataset = TerrainDataset(path)
    faults: list[Fault] = []
    for split in dataset.splits:
        faults += [Fault(split, *fault) for fault in _split_faults(dataset, split)]
    return faults


def _split_faults(
    dataset: TerrainDataset, split: str
) -> Iterator[tuple[int, str, str, str]]:
    """Yield map, field, problem and file of each fault of a split."""
    fields = list(dataset.fields)
    shape = (dataset.map_count(split), len(fields), schema.DIGEST_BYTES)
    stored = np.ma.masked_all(shape, np.uint8)
    computed = stored.copy()
    files: list[str] = []  # name of the shard of each map
    for piece in dataset.pieces[split]:
        shard = piece.path.name if piece.path != dataset.path else ""
        files += [shard] * piece.maps
        try:
            file = open_file(piece.path)
        except DatasetError:
            yield -1, "", _UNREADABLE, shard
            continue
        with file:
            for name in (*fields, schema.ENTRY_DIGESTS):
                try:
                    array = dataset.stored_array(file, split, name, piece.maps)
                except (*READ_ERRORS, TypeError, AttributeError) as error:
                    problem = _UNREADABLE
                    if type(error) is ValueError:
                        problem = str(error).removeprefix("it ")
                    yield -1, name, problem, shard
                    continue
                for start, values in _read_chunks(array):
                    first = piece.first + start
                    if values is None:
                        yield first, name, "is damaged", shard
                        continue
                    maps = slice(first, first + len(values))
                    if name == schema.ENTRY_DIGESTS:
                        stored[maps] = values
                        continue
                    for index in _maps_out_of_range(dataset, split, name, values):
                        yield first + index, name, "is out of range", shard
                    digests = schema.entry_digests(
                        {name: values}, {name: dataset.fields[name]}
                    )
                    computed[maps, fields.index(name)] = digests[:, 0]
            for name in _damaged_scales(file, split, (*fields, schema.ENTRY_DIGESTS)):
                yield -1, name, "is damaged", shard
    is_readable = not np.ma.is_masked(computed)
    differs = (computed != stored).filled(False).any(axis=2)
    digest = schema.split_digest(computed.data, *dataset.grid.shape, dataset.fields)
    if is_readable and digest == dataset.splits[split]["digest"]:
        # The maps match the digest in the manifest, so the stored digests of the maps
        # are damaged.
        for index in np.flatnonzero(differs.any(axis=1)).tolist():
            yield index, schema.ENTRY_DIGESTS, "does not match the map", files[index]
        return
    for index, column in np.argwhere(differs).tolist():
        yield index, fields[column], "does not match its digest", files[index]
    if is_readable and not differs.any():
        yield -1, "", "the maps do not match the digest in the manifest", ""


def _damaged_scales(
    file: h5py.File, split: str, names: Collection[str]
) -> Iterator[str]:
    """Yield the names of unreadable dimension scales of a split.

    Args:
        file: open file.
        split: name of the split.
        names: names of the arrays that are not dimension scales.
    """
    scales: list[str] = []
    with suppress(*READ_ERRORS):
        scales = sorted(set(file[split]) - set(names))
    for name in scales:
        try:
            file[split][name][()]
        except READ_ERRORS:
            yield name


def _read_chunks(array: h5py.Dataset) -> Iterator[tuple[int, np.ndarray | None]]:
    """Yield (index of the first map, values) for chunks of maps.

    Maps of a damaged chunk are read one by one. The values of a damaged map are None.
    """
    step = max(1, CHUNK_CELLS * len(array) // max(1, array.size))
    for start in range(0, len(array), step):
        try:
            yield start, array[start : start + step]
        except READ_ERRORS:
            for index in range(start, min(start + step, len(array))):
                values = None
                with suppress(*READ_ERRORS):
                    values = array[index : index + 1]
                yield index, values


def _maps_out_of_range(
    dataset: TerrainDataset, split: str, name: str, values: np.ndarray
) -> list[int]:
    """Return the indices of maps with a value out of range."""
    field = dataset.fields[name]
    maximum = len(dataset.recipe.classes) - 1 if name == "class_id" else field.maximum
    is_valid = (values >= field.minimum) & (values <= maximum)
    if name == "class_id" and schema.has_unlabelled(dataset.splits[split]):
        is_valid |= values == schema.UNLABELLED
    # NaN marks a reference time that was not requested, λ that was not measured, and
    # the standard deviation of a single row. Fields that this package does not define
    # may also contain NaN.
    may_be_nan = ("reference_time_s", "traversability", "drive_std")
    if name in may_be_nan or name not in (*schema.KNOWN, *schema.TRUTH):
        is_valid |= np.isnan(values)
    return np.flatnonzero(~is_valid.reshape(len(values), -1).all(axis=1)).tolist()
