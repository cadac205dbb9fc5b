"""Checks a whole dataset: schema, ranges, per-chunk checksums, digests."""

from pathlib import Path

import numpy as np

from benchnav.datagen import schema
from benchnav.datagen.store import BLOCK_MAPS, TerrainDataset
from benchnav.errors import DatasetError


def find_faults(path: str | Path) -> list[str]:
    """Reads everything in a dataset and names what is wrong.

    Args:
        path: the file.

    Returns:
        One line a fault; empty when the file is sound.

    Raises:
        DatasetError: the file cannot be opened at all.
    """
    dataset = TerrainDataset(path)
    faults = []
    for split, entry in dataset.splits.items():
        digest = schema.SplitDigest()
        readable = True
        for start in range(0, entry["maps"], BLOCK_MAPS):
            indices = range(start, min(start + BLOCK_MAPS, entry["maps"]))
            block, damaged = _read(dataset, split, indices)
            faults += damaged
            readable = readable and not damaged
            if not damaged:
                faults += _range_faults(dataset, split, indices, block)
                digest.update(block)
        if readable and digest.hexdigest() != entry["digest"]:
            faults.append(
                f"{split}: content digest is {digest.hexdigest()}, the manifest says {entry['digest']}"
            )
    return faults


def _read(dataset: TerrainDataset, split: str, indices: range) -> tuple[dict[str, np.ndarray], list[str]]:
    block, faults = {}, []
    for name in schema.FIELDS:
        try:
            block[name] = dataset.read(split, indices, [name])[name]
        except DatasetError:
            faults += [f for i in indices if (f := _map_fault(dataset, split, i, name))]
    return block, faults


def _map_fault(dataset: TerrainDataset, split: str, index: int, name: str) -> str:
    try:
        dataset.read(split, [index], [name])
    except DatasetError:
        return f"{split}: map {index}: field {name!r} is damaged"
    return ""


def _range_faults(
    dataset: TerrainDataset, split: str, indices: range, block: dict[str, np.ndarray]
) -> list[str]:
    faults = []
    for name, field in schema.FIELDS.items():
        values = block[name]
        shape = field.entry_shape(*dataset.grid.shape)
        if values.dtype != np.dtype(field.dtype) or values.shape[1:] != shape:
            faults.append(
                f"{split}: field {name!r} is {values.dtype} {list(values.shape[1:])}, "
                f"expected {field.dtype} {list(shape)}"
            )
            continue
        allowed = (values >= field.least) & (values <= field.most)
        if name == "reference_time_s":
            allowed |= np.isnan(values)
        if name == "class_id":
            allowed &= values < len(dataset.recipe.classes)
        bad = ~allowed.reshape(len(values), -1).all(axis=1)
        faults += [f"{split}: map {indices[i]}: field {name!r} is out of range" for i in np.flatnonzero(bad)]
    return faults
