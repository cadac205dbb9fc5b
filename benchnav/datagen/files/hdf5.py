"""Writing dataset files (HDF5), whole or not at all.

HDF5's own filters compress and checksum: byte shuffle, deflate, Fletcher-32. Letters in shapes: B maps.
"""

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import benchnav
from benchnav.core.errors import DatasetError
from benchnav.core.store import replacing, seal
from benchnav.datagen import schema
from benchnav.datagen.recipe.recipe import Recipe

# Structures of HDF5 1.10 carry checksums of their own, so that damage to them is found as well.
_LIBRARY = ("v110", "v110")

_VALUES_A_CHUNK = 1024
# Room for what is not maps: HDF5's structures, small fields, digests, manifest.
_SPARE_BYTES = 1 << 18
_SPARE_BYTES_A_MAP = 1024


class Writer:
    """Fills an open file with a dataset, each split's maps in their order.

    Args:
        file: empty.
        dataset_id: name and version of the dataset.
        recipes: what the splits' parts refer to by number. The first gives grid and class table.
        splits: by name, the manifest's entry of each split without its digest.
        fields: what every map has.
    """

    def __init__(
        self,
        file: h5py.File,
        dataset_id: str,
        recipes: Sequence[Recipe],
        splits: Mapping[str, Mapping[str, Any]],
        fields: Mapping[str, schema.Field],
    ) -> None:
        """Makes the empty arrays."""
        self._file, self._id, self._recipes, self._splits = file, dataset_id, recipes, splits
        self._fields = fields
        height, width = recipes[0].grid.shape
        # Kept until all is written: HDF5 writes an array out when it is let go.
        self._arrays = {
            name: _new_arrays(file.create_group(name), entry["maps"], height, width, fields)
            for name, entry in splits.items()
        }
        self._digests = {
            name: schema.SplitDigest(entry["maps"], height, width, fields) for name, entry in splits.items()
        }
        self._written = dict.fromkeys(splits, 0)

    def add(self, split: str, maps: Mapping[str, np.ndarray]) -> None:
        """Writes the next maps of a split, every field of shape [B, *entry shape]."""
        digests = schema.entry_digests(maps, self._fields)
        for name in self._fields:
            self._put(split, name, maps[name])
        self._finish(split, digests)

    def copy(self, split: str, stored: h5py.Group) -> None:
        """Writes all maps of a stored split as the next ones; what is packed alike is not unpacked."""
        for name, field in self._fields.items():
            target = self._arrays[split][name]
            if "H" in field.shape and _packing(stored[name]) == _packing(target):
                _copy_chunks(stored[name], target, self._written[split])
            else:
                self._put(split, name, stored[name][:])
        self._finish(split, stored[schema.ENTRY_DIGESTS][:])

    def close(self) -> None:
        """Writes the manifest."""
        assert self._written == {name: entry["maps"] for name, entry in self._splits.items()}
        splits = {
            name: {**entry, "digest": self._digests[name].hexdigest()} for name, entry in self._splits.items()
        }
        text = seal(manifest_of(self._id, self._recipes, splits, self._fields)).encode()
        self._file.create_dataset(schema.MANIFEST, data=text, dtype=h5py.string_dtype("utf-8", len(text)))
        self._file.flush()

    def _put(self, split: str, name: str, values: np.ndarray) -> None:
        first = self._written[split]
        self._arrays[split][name][first : first + len(values)] = values

    def _finish(self, split: str, digests: np.ndarray) -> None:
        self._put(split, schema.ENTRY_DIGESTS, digests)
        self._digests[split].update(digests)
        self._written[split] += len(digests)


def manifest_of(
    dataset_id: str,
    recipes: Sequence[Recipe],
    splits: Mapping[str, Mapping[str, Any]],
    fields: Mapping[str, schema.Field],
) -> dict[str, Any]:
    """The manifest of a dataset, of splits with their digests."""
    return {
        "format": schema.FORMAT,
        "format_version": schema.version_of(
            [recipe.synthesis for recipe in recipes], splits.values(), fields
        ),
        "id": dataset_id,
        "generator": {"package": "benchnav", "version": benchnav.__version__},
        "fields": schema.field_table(*recipes[0].grid.shape, fields),
        "splits": dict(splits),
        "recipes": [recipe.to_dict() for recipe in recipes],
    }


def pack(
    dataset_id: str, recipe: Recipe, split: str, entry: Mapping[str, Any], maps: Mapping[str, np.ndarray]
) -> bytes:
    """Makes what a file of a few maps of one split holds, in memory.

    Args:
        dataset_id: name and version of the dataset.
        recipe: by which they were made.
        split: name of the split.
        entry: the manifest's entry of the split without its digest.
        maps: every field of `schema.FIELDS`, and others that the dataset has, of shape [B, *entry shape].
    """
    with h5py.File("packed", "w", driver="core", backing_store=False, libver=_LIBRARY) as file:
        writer = Writer(file, dataset_id, [recipe], {split: entry}, schema.fields_in(maps))
        writer.add(split, maps)
        writer.close()
        return file.id.get_file_image()


def is_one_file(path: Path) -> bool:
    """Whether a dataset of this name is one file; else it is a folder of shards."""
    return path.suffix in (".h5", ".hdf5")


def check_target(path: Path, overwrite: bool) -> None:
    """Refuses a target that is there, unless it is to be replaced, and one that is a folder.

    Raises:
        DatasetError: `path` exists and `overwrite` is false, or it is a folder.
    """
    if path.is_dir():
        raise DatasetError(f"Expected `out` to be a file, got the folder {path}.")
    if path.exists() and not overwrite:
        raise DatasetError(
            f"Expected `out` to be a new file, but {path} exists. Pass --overwrite to replace it."
        )


@contextmanager
def writing(
    path: Path,
    dataset_id: str,
    recipes: Sequence[Recipe],
    splits: Mapping[str, Mapping[str, Any]],
    fields: Mapping[str, schema.Field],
    room: int,
) -> Iterator[Writer]:
    """Writes a dataset file that takes its place when it is whole.

    Args:
        path: file to write or replace.
        dataset_id: name and version of the dataset.
        recipes: what the splits' parts refer to by number. The first gives grid and class table.
        splits: by name, the manifest's entry of each split without its digest.
        fields: what every map has.
        room: bytes that the maps take at most.
    """
    room += _SPARE_BYTES + _SPARE_BYTES_A_MAP * sum(entry["maps"] for entry in splits.values())
    with replacing(path) as unfinished:
        with h5py.File(unfinished, "w", libver=_LIBRARY) as file:
            _reserve(unfinished, room)
            writer = Writer(file, dataset_id, recipes, splits, fields)
            yield writer
            writer.close()
            size = file.id.get_filesize()
        os.truncate(unfinished, size)
        if path.exists():
            shutil.copymode(path, unfinished)


@contextmanager
def named_errors(path: Path) -> Iterator[None]:
    """Tells which dataset could not be written.

    Raises:
        DatasetError: the system, or HDF5, could not write.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except BrokenProcessPool as error:
        raise DatasetError(
            f"A worker that made maps of {path} was killed, perhaps for want of memory. Give the same command "
            "again with fewer `jobs`; what was finished is kept."
        ) from error
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise DatasetError(
            f"Could not write {path}: {reason}. When that is mended, give the same command again."
        ) from error


def _new_arrays(
    group: h5py.Group, maps: int, height: int, width: int, fields: Mapping[str, schema.Field]
) -> dict[str, h5py.Dataset]:
    """The empty arrays of a split, those of cells with a map a chunk."""
    shapes = {name: field.entry_shape(height, width) for name, field in fields.items()}
    kinds = {name: field.dtype for name, field in fields.items()}
    shapes[schema.ENTRY_DIGESTS], kinds[schema.ENTRY_DIGESTS] = (len(fields), schema.DIGEST_BYTES), "|u1"
    arrays = {}
    for name, entry in shapes.items():
        chunk = 1 if name in fields and "H" in fields[name].shape else max(1, min(maps, _VALUES_A_CHUNK))
        arrays[name] = group.create_dataset(
            name, (maps, *entry), kinds[name], chunks=(chunk, *entry),
            shuffle=True, compression="gzip", compression_opts=1, fletcher32=True,
        )  # fmt: skip
        if name in fields:
            arrays[name].attrs["unit"] = fields[name].unit
            arrays[name].attrs["meaning"] = fields[name].meaning
    return arrays


def _packing(array: h5py.Dataset) -> tuple[object, ...]:
    """What has to be alike for a chunk of one array to be one of another; the level of deflate need not be."""
    return array.dtype.str, array.chunks, array.shuffle, array.compression, array.fletcher32


def _copy_chunks(source: h5py.Dataset, target: h5py.Dataset, first: int) -> None:
    within = (0,) * (source.ndim - 1)
    for index in range(len(source)):
        mask, chunk = source.id.read_direct_chunk((index, *within))
        target.id.write_direct_chunk((first + index, *within), chunk, mask)


def _reserve(path: Path, size: int) -> None:
    """Takes room on the disk ahead of HDF5, which crashes if it meets a full one.

    Raises:
        OSError: there is no such room.
    """
    if hasattr(os, "posix_fallocate"):
        with open(path, "rb+") as raw:
            os.posix_fallocate(raw.fileno(), 0, size)
