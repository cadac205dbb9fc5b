"""Checks a whole dataset: schema, per-chunk checksums, entry digests, ranges, split
digests.
"""

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

_MISSING = "is missing or cannot be opened"


class Fault(NamedTuple):
    """Something wrong with a dataset.

    Args:
        split: where it is.
        map: which map; −1 where it is not one map.
        field: which array of the split; empty where it is none of them.
        problem: what is wrong with it.
        file: name of the shard that holds it; empty where the dataset is one file.
    """

    split: str
    map: int
    field: str
    problem: str
    file: str = ""

    def __str__(self) -> str:
        """One line."""
        return next(summarise([self]))


def summarise(faults: list[Fault]) -> Iterator[str]:
    """Writes a line a fault, consecutive maps with the same fault in one."""

    def run_of(item: tuple[int, Fault]) -> Fault:
        place, fault = item
        return fault._replace(map=fault.map - place)

    order = sorted(faults, key=attrgetter("split", "field", "problem", "file", "map"))
    for _, items in groupby(enumerate(order), run_of):
        (_, first), *others = items
        maps = f"map {first.map}" if first.map >= 0 else ""
        if others:
            maps = f"maps {first.map}–{first.map + len(others)}"
        problem = (
            f"field {first.field!r} {first.problem}" if first.field else first.problem
        )
        where = f" ({first.file})" if first.file else ""
        yield ": ".join(word for word in (first.split, maps, problem) if word) + where


def find_faults(path: str | Path) -> list[Fault]:
    """Reads everything in a dataset and names what is wrong.

    Args:
        path: the file or folder.

    Returns:
        The faults, every damaged map and field among them; empty when the file is
        sound.

    Raises:
        DatasetError: the file or its manifest cannot be read at all.
    """
    dataset = TerrainDataset(path)
    return [
        Fault(split, *about)
        for split in dataset.splits
        for about in _split_faults(dataset, split)
    ]


def _split_faults(
    dataset: TerrainDataset, split: str
) -> Iterator[tuple[int, str, str, str]]:
    """The faults of a split: map, field, problem and file of each."""
    fields = list(dataset.fields)
    stored = np.ma.masked_all(
        (dataset.map_count(split), len(fields), schema.DIGEST_BYTES), np.uint8
    )
    computed = stored.copy()
    files: list[str] = []  # of each map
    for piece in dataset.pieces[split]:
        own = piece.path.name if piece.path != dataset.path else ""
        files += [own] * piece.maps
        try:
            file = open_file(piece.path)
        except DatasetError:
            yield -1, "", _MISSING, own
            continue
        with file:
            for name in (*fields, schema.ENTRY_DIGESTS):
                try:
                    array = dataset.stored_array(file, split, name, piece.maps)
                except (*READ_ERRORS, TypeError, AttributeError) as error:
                    is_other = type(error) is ValueError
                    yield (
                        -1,
                        name,
                        str(error).removeprefix("it ") if is_other else _MISSING,
                        own,
                    )
                    continue
                for place, values in _read_some(array):
                    first = piece.first + place
                    if values is None:
                        yield first, name, "is damaged", own
                        continue
                    maps = slice(first, first + len(values))
                    if name == schema.ENTRY_DIGESTS:
                        stored[maps] = values
                        continue
                    for index in _out_of_range(dataset, split, name, values):
                        yield first + index, name, "is out of range", own
                    digests = schema.entry_digests(
                        {name: values}, {name: dataset.fields[name]}
                    )
                    computed[maps, fields.index(name)] = digests[:, 0]
            for name in _damaged_scales(file, split, (*fields, schema.ENTRY_DIGESTS)):
                yield -1, name, "is damaged", own
    is_readable = not np.ma.is_masked(computed)
    unlike = (computed != stored).filled(False).any(axis=2)
    digest = schema.split_digest(computed.data, *dataset.grid.shape, dataset.fields)
    if is_readable and digest == dataset.splits[split]["digest"]:
        # The maps are what the manifest says, so it is the digests beside them that
        # differ.
        for index in np.flatnonzero(unlike.any(axis=1)).tolist():
            yield index, schema.ENTRY_DIGESTS, "does not match the map", files[index]
        return
    for index, column in np.argwhere(unlike).tolist():
        yield index, fields[column], "does not match its digest", files[index]
    if is_readable and not unlike.any():
        yield -1, "", "the maps do not match the digest in the manifest", ""


def _damaged_scales(
    file: h5py.File, split: str, known: Collection[str]
) -> Iterator[str]:
    """Name what else lies in a split, such as dimension scales, and cannot be read."""
    others: list[str] = []
    with suppress(*READ_ERRORS):
        others = sorted(set(file[split]) - set(known))
    for name in others:
        try:
            file[split][name][()]
        except READ_ERRORS:
            yield name


def _read_some(array: h5py.Dataset) -> Iterator[tuple[int, np.ndarray | None]]:
    """Reads some maps at a time, from the first given on; each one, or None, of those
    that cannot be read together.
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


def _out_of_range(
    dataset: TerrainDataset, split: str, name: str, values: np.ndarray
) -> list[int]:
    """Which maps have a value that may not be."""
    field = dataset.fields[name]
    most = len(dataset.recipe.classes) - 1 if name == "class_id" else field.most
    allowed = (values >= field.least) & (values <= most)
    if name == "class_id" and schema.has_unlabelled(dataset.splits[split]):
        allowed |= values == schema.UNLABELLED
    # Not asked for; not observed; of one row; what a field that is not ours means by
    # it, it may mean.
    gaps = ("reference_time_s", "traversability", "drive_std")
    if name in gaps or name not in (*schema.KNOWN, *schema.TRUTH):
        allowed |= np.isnan(values)
    return np.flatnonzero(~allowed.reshape(len(values), -1).all(axis=1)).tolist()
