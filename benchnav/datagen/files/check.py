"""Checks a whole dataset: schema, per-chunk checksums, entry digests, ranges, split digests."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from benchnav.datagen import schema
from benchnav.datagen.files.block import BLOCK_MAPS, spans
from benchnav.datagen.files.reader import READ_ERRORS, TerrainDataset


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
        place = f"map {self.map}" if self.map >= 0 else ""
        return _line(self, place)


def summarise(faults: list[Fault]) -> Iterator[str]:
    """Writes a line a fault, consecutive maps with the same fault in one."""
    kinds: dict[tuple[str, str, str], list[Fault]] = {}
    for fault in sorted(faults):
        kinds.setdefault((fault.split, fault.field, fault.problem), []).append(fault)
    for alike in kinds.values():
        maps = np.array([fault.map for fault in alike])
        for run in np.split(maps, np.flatnonzero(np.diff(maps) != 1) + 1):
            if len(run) > 1:
                yield _line(alike[0], f"maps {run[0]}–{run[-1]}")
            else:
                yield str(replace(alike[0], map=int(run[0])))


def _line(fault: Fault, place: str) -> str:
    words = [fault.split, place, f"field {fault.field!r} {fault.problem}" if fault.field else fault.problem]
    return ": ".join(word for word in words if word)


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
    for start, block in _read_blocks(sound, maps):
        yield from (Fault(split, start, name, "is damaged") for name in sound if name not in block)
        fields = [name for name in schema.FIELDS if name in block]
        for name in fields:
            yield from _out_of_range(split, name, block[name], start, len(dataset.recipe.classes))
        readable = readable and len(fields) == len(schema.FIELDS)
        if not fields:
            continue
        digests = schema.entry_digests(block, fields)
        if readable:
            digest.update(digests)
        if schema.ENTRY_DIGESTS in block:
            columns = [list(schema.FIELDS).index(name) for name in fields]
            differ = (digests != block[schema.ENTRY_DIGESTS][:, columns]).any(axis=2)
            unlike += [(start + index, fields[column]) for index, column in np.argwhere(differ).tolist()]
    if readable and digest.hexdigest() == dataset.splits[split]["digest"]:
        # The maps are what the manifest says, so it is the digests beside them that differ.
        for index in sorted({index for index, _ in unlike}):
            yield Fault(split, index, schema.ENTRY_DIGESTS, "does not match the map")
        return
    for index, name in unlike:
        yield Fault(split, index, name, "does not match its digest")
    if readable and not unlike:
        yield Fault(split, -1, "", "the maps do not match the digest in the manifest")


def _read_blocks(arrays: dict[str, h5py.Dataset], maps: int) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Reads blocks of maps; of one that cannot be read whole, each map, with the arrays that can be read."""
    for start, stop in spans(maps, BLOCK_MAPS):
        try:
            yield start, {name: array[start:stop] for name, array in arrays.items()}
        except READ_ERRORS:
            for index in range(start, stop):
                readable = {}
                for name, array in arrays.items():
                    with suppress(*READ_ERRORS):
                        readable[name] = array[index : index + 1]
                yield index, readable


def _out_of_range(split: str, name: str, values: np.ndarray, start: int, classes: int) -> Iterator[Fault]:
    field = schema.FIELDS[name]
    most = classes - 1 if name == "class_id" else field.most
    allowed = (values >= field.least) & (values <= most)
    if name in ("reference_time_s", "traversability"):  # not asked for; not observed
        allowed |= np.isnan(values)
    for index in np.flatnonzero(~allowed.reshape(len(values), -1).all(axis=1)):
        yield Fault(split, start + int(index), name, "is out of range")
