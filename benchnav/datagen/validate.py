"""Checks a whole dataset: schema, per-chunk checksums, entry digests, ranges, split digests."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from benchnav.datagen import schema
from benchnav.datagen.store import READ_ERRORS, TerrainDataset

_BLOCK_MAPS = 64


@dataclass(frozen=True, order=True)
class Fault:
    """Something wrong with a dataset.

    Args:
        split: where it is.
        map: which map; −1 where it is not one map.
        field: which array of the split; empty where it is none of them.
        problem: what is wrong with it.
    """

    split: str
    map: int
    field: str
    problem: str

    def __str__(self) -> str:
        """One line."""
        place = self.split + (f": map {self.map}" if self.map >= 0 else "")
        return f"{place}: field {self.field!r} {self.problem}" if self.field else f"{place}: {self.problem}"


def find_faults(path: str | Path) -> list[Fault]:
    """Reads everything in a dataset and names what is wrong.

    Args:
        path: the file.

    Returns:
        The faults, every damaged map and field among them; empty when the file is sound.

    Raises:
        DatasetError: the file or its manifest cannot be read at all.
    """
    dataset = TerrainDataset(path)
    faults: list[Fault] = []
    with h5py.File(path, "r") as file:
        for split in dataset.splits:
            faults += _split_faults(dataset, file, split)
    return faults


def _split_faults(dataset: TerrainDataset, file: h5py.File, split: str) -> Iterator[Fault]:
    maps = dataset.splits[split]["maps"]
    height, width = dataset.grid.shape
    sound: dict[str, h5py.Dataset] = {}
    wanted = {name: (field.dtype, field.entry_shape(height, width)) for name, field in schema.FIELDS.items()}
    wanted[schema.ENTRY_DIGESTS] = ("|u1", (len(schema.FIELDS), schema.DIGEST_BYTES))
    for name, (dtype, entry) in wanted.items():
        try:
            array = file[f"{split}/{name}"]
            found = (array.dtype.str, array.shape)
        except READ_ERRORS:
            yield Fault(split, -1, name, "is missing or cannot be opened")
            continue
        if found == (dtype, (maps, *entry)):
            sound[name] = array
        else:
            yield Fault(split, -1, name, f"is {found[0]} {list(found[1])}, not {dtype} {[maps, *entry]}")
    digest, readable = schema.SplitDigest(maps, height, width), set(schema.FIELDS) <= set(sound)
    unlike: list[tuple[int, str]] = []
    for start in range(0, maps, _BLOCK_MAPS):
        stop = min(start + _BLOCK_MAPS, maps)
        block: dict[str, np.ndarray] = {}
        for name, array in sound.items():
            try:
                block[name] = array[start:stop]
            except READ_ERRORS:
                yield from _damaged_entries(split, name, array, start, stop)
        for name in set(block) & set(schema.FIELDS):
            yield from _out_of_range(split, name, block[name], start, len(dataset.recipe.classes))
        if not set(schema.FIELDS) <= set(block):
            readable = False
            continue
        digests = schema.entry_digests(block)
        digest.update(digests)
        if schema.ENTRY_DIGESTS in block:
            differ = np.argwhere((digests != block[schema.ENTRY_DIGESTS]).any(axis=2)).tolist()
            unlike += [(start + index, list(schema.FIELDS)[column]) for index, column in differ]
    if readable and digest.hexdigest() == dataset.splits[split]["digest"]:
        # The maps are what the manifest says, so it is the digests beside them that differ.
        for index in sorted({index for index, _ in unlike}):
            yield Fault(split, index, schema.ENTRY_DIGESTS, "does not match the map")
        return
    for index, name in unlike:
        yield Fault(split, index, name, "does not match its digest")
    if readable and not unlike:
        yield Fault(split, -1, "", "the maps do not match the digest in the manifest")


def _damaged_entries(split: str, name: str, array: h5py.Dataset, start: int, stop: int) -> Iterator[Fault]:
    """Names the maps of a stretch that cannot be read."""
    for index in range(start, stop):
        try:
            array[index]
        except READ_ERRORS:
            yield Fault(split, index, name, "is damaged")


def _out_of_range(split: str, name: str, values: np.ndarray, start: int, classes: int) -> Iterator[Fault]:
    field = schema.FIELDS[name]
    most = classes - 1 if name == "class_id" else field.most
    allowed = (values >= field.least) & (values <= most)
    if name == "reference_time_s":
        allowed |= np.isnan(values)
    for index in np.flatnonzero(~allowed.reshape(len(values), -1).all(axis=1)):
        yield Fault(split, start + int(index), name, "is out of range")
