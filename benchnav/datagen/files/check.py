"""Checks a whole dataset: schema, per-chunk checksums, entry digests, ranges, split digests."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from benchnav.core.errors import DatasetError
from benchnav.datagen import schema
from benchnav.datagen.files.reader import CHUNK_CELLS, READ_ERRORS, TerrainDataset, open_file


@dataclass(frozen=True, order=True)
class Fault:
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
        place = f"map {self.map}" if self.map >= 0 else ""
        return _line(self, place)


def summarise(faults: list[Fault]) -> Iterator[str]:
    """Writes a line a fault, consecutive maps with the same fault in one."""
    kinds: dict[tuple[str, str, str, str], list[Fault]] = {}
    for fault in sorted(faults):
        kinds.setdefault((fault.split, fault.field, fault.problem, fault.file), []).append(fault)
    for alike in kinds.values():
        maps = np.array([fault.map for fault in alike])
        for run in np.split(maps, np.flatnonzero(np.diff(maps) != 1) + 1):
            if len(run) > 1:
                yield _line(alike[0], f"maps {run[0]}–{run[-1]}")
            else:
                yield str(replace(alike[0], map=int(run[0])))


def _line(fault: Fault, place: str) -> str:
    words = [fault.split, place, f"field {fault.field!r} {fault.problem}" if fault.field else fault.problem]
    where = f" ({fault.file})" if fault.file else ""
    return ": ".join(word for word in words if word) + where


def find_faults(path: str | Path) -> list[Fault]:
    """Reads everything in a dataset and names what is wrong.

    Args:
        path: the file or folder.

    Returns:
        The faults, every damaged map and field among them; empty when the file is sound.

    Raises:
        DatasetError: the file or its manifest cannot be read at all.
    """
    dataset = TerrainDataset(path)
    return [fault for split in dataset.splits for fault in _split_faults(dataset, split)]


def _split_faults(dataset: TerrainDataset, split: str) -> Iterator[Fault]:
    own = dataset.fields
    digest = schema.SplitDigest(dataset.map_count(split), *dataset.grid.shape, own)
    unlike: list[Fault] = []  # maps that do not match the digests beside them
    readable = True
    for piece in dataset.pieces(split):
        name = piece.path.name if piece.path != dataset.path else ""
        try:
            file = open_file(piece.path)
        except DatasetError:
            yield Fault(split, -1, "", "is missing or cannot be opened", name)
            readable = False
            continue
        with file:
            sound, faults = _arrays(file, split, piece.maps, dataset)
            yield from (replace(fault, file=name) for fault in faults)
            readable = readable and set(own) <= set(sound)
            for start, maps in _read_some(sound, piece.maps):
                first = piece.first + start
                yield from (
                    Fault(split, first, field, "is damaged", name) for field in sound if field not in maps
                )
                fields = {name: field for name, field in own.items() if name in maps}
                classes = len(dataset.recipe.classes)
                unlabelled = schema.has_unlabelled(dataset.splits[split])
                for field in fields:
                    faulty = _out_of_range(field, fields[field], maps[field], classes, unlabelled)
                    yield from (Fault(split, first + i, field, "is out of range", name) for i in faulty)
                readable = readable and len(fields) == len(own)
                if not fields:
                    continue
                digests = schema.entry_digests(maps, fields)
                if readable:
                    digest.update(digests)
                if schema.ENTRY_DIGESTS in maps:
                    columns = [list(own).index(field) for field in fields]
                    differ = (digests != maps[schema.ENTRY_DIGESTS][:, columns]).any(axis=2)
                    unlike += [
                        Fault(split, first + index, list(fields)[column], "does not match its digest", name)
                        for index, column in np.argwhere(differ).tolist()
                    ]
    if readable and digest.hexdigest() == dataset.splits[split]["digest"]:
        # The maps are what the manifest says, so it is the digests beside them that differ.
        told = {fault.map: fault for fault in unlike}
        for index in sorted(told):
            yield replace(told[index], field=schema.ENTRY_DIGESTS, problem="does not match the map")
        return
    yield from unlike
    if readable and not unlike:
        yield Fault(split, -1, "", "the maps do not match the digest in the manifest")


def _arrays(
    file: h5py.File, split: str, maps: int, dataset: TerrainDataset
) -> tuple[dict[str, h5py.Dataset], list[Fault]]:
    """The arrays of a split in a file that are as they should be, and what is wrong with the others."""
    shapes = {name: field.entry_shape(*dataset.grid.shape) for name, field in dataset.fields.items()}
    wanted = {name: (field.dtype, shapes[name]) for name, field in dataset.fields.items()}
    wanted[schema.ENTRY_DIGESTS] = ("|u1", (len(dataset.fields), schema.DIGEST_BYTES))
    sound, faults = {}, []
    for name, (dtype, entry) in wanted.items():
        try:
            array = file[f"{split}/{name}"]
            found = (array.dtype.str, array.shape)
        except (*READ_ERRORS, TypeError, AttributeError):
            faults.append(Fault(split, -1, name, "is missing or cannot be opened"))
            continue
        if found == (dtype, (maps, *entry)):
            sound[name] = array
        else:
            problem = f"is {found[0]} {list(found[1])}, not {dtype} {[maps, *entry]}"
            faults.append(Fault(split, -1, name, problem))
    return sound, faults


def _read_some(arrays: dict[str, h5py.Dataset], maps: int) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Reads some maps at a time; of those that cannot be read together each one, with the arrays that can be read."""
    cells = max((int(np.prod(array.shape[1:])) for array in arrays.values()), default=1)
    step = max(1, CHUNK_CELLS // max(1, cells))
    for start in range(0, maps, step):
        stop = min(start + step, maps)
        try:
            yield start, {name: array[start:stop] for name, array in arrays.items()}
        except READ_ERRORS:
            for index in range(start, stop):
                readable = {}
                for name, array in arrays.items():
                    with suppress(*READ_ERRORS):
                        readable[name] = array[index : index + 1]
                yield index, readable


def _out_of_range(
    name: str, field: schema.Field, values: np.ndarray, classes: int, unlabelled: bool
) -> list[int]:
    """Which maps have a value that may not be."""
    most = classes - 1 if name == "class_id" else field.most
    allowed = (values >= field.least) & (values <= most)
    if name == "class_id" and unlabelled:
        allowed |= values == schema.UNLABELLED
    # Not asked for; not observed; what a field that is not ours means by it, it may mean.
    if name in ("reference_time_s", "traversability") or name not in schema.FIELDS | schema.OPTIONAL:
        allowed |= np.isnan(values)
    return np.flatnonzero(~allowed.reshape(len(values), -1).all(axis=1)).tolist()
