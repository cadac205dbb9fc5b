"""Writing datasets (HDF5), whole or not at all: a file, or a folder of such files with one manifest.

HDF5's own filters compress and checksum: byte shuffle, deflate, Fletcher-32. Letters in shapes: B maps.
"""

import os
import re
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import benchnav
from benchnav.core.errors import DatasetError
from benchnav.core.store import refuse_taken, replacing, seal, take_place, write_text
from benchnav.datagen import schema
from benchnav.datagen.files.reader import FOLDER_MANIFEST, open_file, read_manifest
from benchnav.datagen.recipe.recipe import Recipe

FOLDER_FORMAT_VERSION = "1.2"  # at least

# Structures of HDF5 1.10 carry checksums of their own, so that damage to them is found as well.
_LIBRARY = ("v110", "v110")

_VALUES_A_CHUNK = 1024
# Room for what is not maps: HDF5's structures, small fields, digests, manifest.
_SPARE_BYTES = 1 << 18
_SPARE_BYTES_A_MAP = 1024

_SHARD = re.compile(r".+-\d{8}-\d{8}\.h5")
_HALF = re.compile(r"\..+\.partial")  # of a shard or of the manifest

Splits = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Contents:
    """What a dataset is to hold, and the files that hold it.

    Args:
        id: name and version of the dataset.
        recipes: what the splits' parts refer to by number. The first gives grid and class table.
        splits: by name, the manifest's entry of each split without its digest.
        files: by split the files that hold its maps, in their order, each under the split's name.
        fields: what every map has.
    """

    id: str
    recipes: Sequence[Recipe]
    splits: Splits
    files: Mapping[str, Sequence[Path]] = field(default_factory=dict)
    fields: Mapping[str, schema.Field] = field(default_factory=lambda: schema.FIELDS)

    def new_digests(self) -> dict[str, schema.SplitDigest]:
        """The digests of the splits, of no maps yet."""
        shape = self.recipes[0].grid.shape
        return {
            name: schema.SplitDigest(entry["maps"], *shape, self.fields)
            for name, entry in self.splits.items()
        }

    def manifest(self, digests: Mapping[str, schema.SplitDigest]) -> dict[str, Any]:
        """The manifest, of digests of all maps."""
        synthesis = [recipe.synthesis for recipe in self.recipes]
        return {
            "format": schema.FORMAT,
            "format_version": schema.version_of(synthesis, self.splits.values(), self.fields),
            "id": self.id,
            "generator": {"package": "benchnav", "version": benchnav.__version__},
            "fields": schema.field_table(*self.recipes[0].grid.shape, self.fields),
            "splits": {
                name: {**entry, "digest": digests[name].hexdigest()} for name, entry in self.splits.items()
            },
            "recipes": [recipe.to_dict() for recipe in self.recipes],
        }


def whole(recipe: Recipe, files: Mapping[str, Sequence[Path]]) -> Contents:
    """All maps of a recipe, by split the files that hold them."""
    splits = {name: recipe_entry(recipe, name, 0, spec.maps) for name, spec in recipe.splits.items()}
    return Contents(id=recipe.id, recipes=[recipe], splits=splits, files=files)


def recipe_entry(recipe: Recipe, split: str, first: int, stop: int) -> dict[str, Any]:
    """The manifest's entry of consecutive maps of a recipe's split, without their digest."""
    part = {"maps": stop - first, "recipe": 0, "split": split, "first": first}
    return {"scenario": recipe.splits[split].scenario, "maps": stop - first, "parts": [part]}


class Writer:
    """Fills an open file with a dataset, each split's maps in their order.

    Args:
        file: empty.
        contents: what the dataset is to hold.
    """

    def __init__(self, file: h5py.File, contents: Contents) -> None:
        """Makes the empty arrays."""
        self._file, self._contents = file, contents
        # Kept until all is written: HDF5 writes an array out when it is let go.
        self._arrays = {
            name: _new_arrays(file.create_group(name), entry["maps"], contents)
            for name, entry in contents.splits.items()
        }
        self._digests = contents.new_digests()
        self._written = dict.fromkeys(contents.splits, 0)

    def add(self, split: str, maps: Mapping[str, np.ndarray]) -> None:
        """Writes the next maps of a split, every field of shape [B, *entry shape]."""
        for name in self._contents.fields:
            self._put(split, name, maps[name])
        self._finish(split, schema.entry_digests(maps, self._contents.fields))

    def copy(self, split: str, stored: h5py.Group) -> None:
        """Writes all maps of a stored split as the next ones; what is packed alike is not unpacked."""
        for name, kind in self._contents.fields.items():
            target = self._arrays[split][name]
            if "H" in kind.shape and _packing(stored[name]) == _packing(target):
                _copy_chunks(stored[name], target, self._written[split])
            else:
                self._put(split, name, stored[name][:])
        self._finish(split, stored[schema.ENTRY_DIGESTS][:])

    def close(self) -> None:
        """Writes the manifest."""
        assert self._written == {name: entry["maps"] for name, entry in self._contents.splits.items()}
        text = seal(self._contents.manifest(self._digests)).encode()
        self._file.create_dataset(schema.MANIFEST, data=text, dtype=h5py.string_dtype("utf-8", len(text)))
        self._file.flush()

    def _put(self, split: str, name: str, values: np.ndarray) -> None:
        first = self._written[split]
        self._arrays[split][name][first : first + len(values)] = values

    def _finish(self, split: str, digests: np.ndarray) -> None:
        self._put(split, schema.ENTRY_DIGESTS, digests)
        self._digests[split].update(digests)
        self._written[split] += len(digests)


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
    contents = Contents(id=dataset_id, recipes=[recipe], splits={split: entry}, fields=schema.fields_in(maps))
    with h5py.File("packed", "w", driver="core", backing_store=False, libver=_LIBRARY) as file:
        writer = Writer(file, contents)
        writer.add(split, maps)
        writer.close()
        return file.id.get_file_image()


def is_one_file(path: Path) -> bool:
    """Whether a dataset of this name is one file; else it is a folder of shards."""
    return path.suffix in (".h5", ".hdf5")


def check_place(path: Path, overwrite: bool, names: Collection[str] = ()) -> None:
    """Refuses a place for a dataset that is taken.

    Args:
        path: file or folder.
        overwrite: whether a dataset, or any file of this name, may be replaced.
        names: of shards that are to be made in the folder, which may be damaged.

    Raises:
        ConfigError: it is.
    """
    refuse_taken(path, overwrite, lambda path: _foreign(path, names))


def _foreign(path: Path, names: Collection[str]) -> str:
    """Says what of another kind a place holds; a folder may hold shards and their manifest alone."""
    if is_one_file(path) or not path.is_dir():
        return "" if is_one_file(path) == path.is_file() else f"is a {'folder' if path.is_dir() else 'file'}"
    files = sorted(path.iterdir())
    try:
        shards = read_manifest(path).get("shards", {})
        known = {shard["file"] for several in shards.values() for shard in several}
        ours = bool(known)
    except DatasetError:  # a damaged manifest is one where shards lie beside it
        known, ours = set(), any(_SHARD.fullmatch(file.name) for file in files)
    known |= {FOLDER_MANIFEST, *names} if ours else {*names}
    for file in files:
        if file.name not in known and not _is_ours(file):
            return f"holds {file.name}"
    return ""


def _is_ours(file: Path) -> bool:
    """Tells whether a file is a shard, of whatever dataset, or what is half-written of one."""
    try:
        return bool(_HALF.fullmatch(file.name) or (_SHARD.fullmatch(file.name) and read_manifest(file)))
    except DatasetError:
        return False


def assemble(contents: Contents, folder: Path, out: Path) -> None:
    """Makes a dataset of files, each of which is one by itself.

    Args:
        contents: what it holds. For a folder all files lie in `folder`.
        folder: beside `out`, whose place it takes; or `out` itself. Of a file it changes nothing.
        out: file or folder.

    Raises:
        ConfigError: something else has come to be in the folder that is replaced.
    """
    if is_one_file(out):
        _join(out, contents)
        return
    digests = contents.new_digests()
    shards: dict[str, list[dict[str, Any]]] = {name: [] for name in contents.splits}
    for name, files in contents.files.items():
        for path in files:
            with open_file(path) as file:
                entries = file[name][schema.ENTRY_DIGESTS][:]
            digests[name].update(entries)
            shards[name].append({"file": path.name, "maps": len(entries)})
    manifest = contents.manifest(digests)
    version = max(manifest["format_version"], FOLDER_FORMAT_VERSION)
    write_text(folder / FOLDER_MANIFEST, seal(manifest | {"format_version": version, "shards": shards}))
    if folder != out:
        check_place(out, True)  # others may have put something there meanwhile
        take_place(folder, out)


def _join(path: Path, contents: Contents) -> None:
    """Writes one file of many."""
    stored = [file.stat().st_size for files in contents.files.values() for file in files]
    maps = sum(entry["maps"] for entry in contents.splits.values())
    with replacing(path) as unfinished:
        with h5py.File(unfinished, "w", libver=_LIBRARY) as file:
            _reserve(unfinished, sum(stored) + _SPARE_BYTES + _SPARE_BYTES_A_MAP * maps)
            writer = Writer(file, contents)
            for split, files in contents.files.items():
                for source in files:
                    with open_file(source) as part:
                        writer.copy(split, part[split])
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
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise DatasetError(
            f"Could not write {path}: {reason}. When that is mended, give the same command again."
        ) from error


def _new_arrays(group: h5py.Group, maps: int, contents: Contents) -> dict[str, h5py.Dataset]:
    """The empty arrays of a split, those of cells with a map a chunk."""
    fields, (height, width) = contents.fields, contents.recipes[0].grid.shape
    kinds = {name: (kind.dtype, kind.entry_shape(height, width)) for name, kind in fields.items()}
    kinds[schema.ENTRY_DIGESTS] = ("|u1", (len(fields), schema.DIGEST_BYTES))
    arrays = {}
    for name, (dtype, entry) in kinds.items():
        chunk = 1 if name in fields and "H" in fields[name].shape else max(1, min(maps, _VALUES_A_CHUNK))
        arrays[name] = group.create_dataset(
            name, (maps, *entry), dtype, chunks=(chunk, *entry),
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
