"""Atomic writing of datasets: an HDF5 file, or a folder of such files.

HDF5's filters compress the data (byte shuffle, deflate) and add checksums
(Fletcher-32). Letters in shapes: B maps.
"""

import os
import re
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy import ndarray

import benchnav
from benchnav.core.errors import DatasetError, out_of_memory_error
from benchnav.core.store import (
    check_replaceable,
    replace_folder,
    replacing,
    restore,
    seal,
    sole_writer,
    write_text,
)
from benchnav.datagen import schema
from benchnav.datagen.files.manifest import FOLDER_MANIFEST, open_file, read_manifest
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import Recipe

FOLDER_FORMAT_VERSION = "1.2"  # minimum format version of a folder of shards

# The file structures of HDF5 1.10 have checksums, which detect damage.
_LIBRARY = ("v110", "v110")

_VALUES_PER_CHUNK = 1024
# Allocated space for HDF5's structures, small fields, digests and the manifest.
_SPARE_BYTES = 1 << 18
_SPARE_BYTES_PER_MAP = 1024

_SHARD = re.compile(r".+-\d{8}-\d{8}\.h5")
_PARTIAL = re.compile(r"\..+\.partial")  # unfinished shard or manifest

# Arrays by name, in memory or in a file, including `ENTRY_DIGESTS`.
Source = Mapping[str, Any]


class Contents(NamedTuple):
    """Contents of a dataset to be written, and the files with its maps.

    Args:
        id: name and version of the dataset.
        recipes: recipes, to which parts of splits refer by index. The first recipe
            determines grid and class table.
        splits: manifest entries by split, without the digest.
        files: paths of the files with the maps, in order, by split.
        fields: fields of each map.
    """

    id: str
    recipes: Sequence[Recipe]
    splits: Mapping[str, schema.Json]
    files: Mapping[str, Sequence[Path]] = {}
    fields: schema.Fields = schema.FIELDS

    def manifest(self, entry_digests: Mapping[str, ndarray]) -> schema.Json:
        """Return the manifest.

        Args:
            entry_digests: digests from `schema.entry_digests`, by split.
        """
        recipes = [recipe.to_dict() for recipe in self.recipes]
        shape = self.recipes[0].grid.shape
        version = schema.version_of(recipes, self.splits.values(), self.fields)
        splits = {}
        for name, entry in self.splits.items():
            digests = entry_digests[name]
            digest = schema.split_digest(digests, *shape, self.fields)
            splits[name] = {**entry, "digest": digest}
        return {
            "format": schema.FORMAT,
            "format_version": version,
            "id": self.id,
            "generator": {"package": "benchnav", "version": benchnav.__version__},
            "fields": schema.field_table(*shape, self.fields),
            "splits": splits,
            "recipes": recipes,
        }


class ShardFile(NamedTuple):
    """File of consecutive maps of a recipe's split; the file is itself a dataset.

    Args:
        split: name of the split.
        first: index of the first map.
        stop: index after the last map.
    """

    split: str
    first: int
    stop: int

    @property
    def maps(self) -> int:
        """Number of maps."""
        return self.stop - self.first

    @property
    def name(self) -> str:
        """Name of the file."""
        return f"{self.split.replace('/', '+')}-{self.first:08d}-{self.stop:08d}.h5"


def contents_of_recipe(recipe: Recipe, files: Mapping[str, Sequence[Path]]) -> Contents:
    """Return the contents of a dataset with all maps of a recipe.

    Args:
        recipe: recipe of the maps.
        files: paths of the files with the maps, in order, by split.
    """
    splits = {
        name: recipe_entry(recipe, ShardFile(name, 0, spec.maps))
        for name, spec in recipe.splits.items()
    }
    return Contents(recipe.id, [recipe], splits, files, recipe.fields)


def recipe_entry(recipe: Recipe, shard: ShardFile) -> schema.Json:
    """Return the manifest entry of a shard's maps, without the digest."""
    part = {"maps": shard.maps, "recipe": 0, "split": shard.split, "first": shard.first}
    return {
        "scenario": recipe.splits[shard.split].scenario,
        "maps": shard.maps,
        "parts": [part],
    }


def _fill(
    file: h5py.File, contents: Contents, sources: Mapping[str, Iterable[Source]]
) -> None:
    """Write a dataset to an empty file.

    Args:
        file: open file.
        contents: contents of the dataset.
        sources: arrays of consecutive maps, which are concatenated, by split.
    """
    kinds = schema.stored_arrays(contents.fields, *contents.recipes[0].grid.shape)
    # All arrays are referenced until the end, since HDF5 writes an array when its last
    # reference is deleted.
    arrays: dict[str, dict[str, h5py.Dataset]] = {}
    for split, split_entry in contents.splits.items():
        arrays[split] = {}
        group = file.create_group(split)
        maps = split_entry["maps"]
        for name, (dtype, entry) in kinds.items():
            field = contents.fields.get(name)
            # A chunk of a field with values per cell contains one map.
            chunk = max(1, min(maps, _VALUES_PER_CHUNK))
            if field and "H" in field.shape:
                chunk = 1
            array = group.create_dataset(
                name,
                (maps, *entry),
                dtype,
                chunks=(chunk, *entry),
                shuffle=True,
                compression="gzip",
                compression_opts=1,
                fletcher32=True,
            )
            if field:
                array.attrs.update(unit=field.unit, meaning=field.meaning)
            arrays[split][name] = array
        _add_scales(group, contents)
    for split, split_sources in sources.items():
        first = 0
        for source in split_sources:
            for name, target in arrays[split].items():
                _put(source[name], target, first)
            first += len(source[schema.ENTRY_DIGESTS])
    digests = {
        split: by_name[schema.ENTRY_DIGESTS][:] for split, by_name in arrays.items()
    }
    text = seal(contents.manifest(digests)).encode()
    dtype = h5py.string_dtype("utf-8", len(text))
    file.create_dataset(schema.MANIFEST, data=text, dtype=dtype)
    file.flush()


def _add_scales(group: h5py.Group, contents: Contents) -> None:
    """Name the dimensions of a split's arrays by HDF5 dimension scales.

    The names are map_index, y_m, x_m, and axis_N for any other dimension of length N.
    """
    recipe = contents.recipes[0]
    for name, array in list(group.items()):
        field = contents.fields.get(name)
        shape = field.shape if field else array.shape[1:]
        labels = ({"H": "y_m", "W": "x_m"}.get(str(n), f"axis_{n}") for n in shape)
        for dimension, label in enumerate(("map_index", *labels)):
            if label in contents.fields:
                continue
            if label not in group:
                values = np.arange(array.shape[dimension])
                if label in ("y_m", "x_m"):
                    values = recipe.resolution_m * (values + 0.5)
                group.create_dataset(label, data=values, fletcher32=True)
                group[label].make_scale(label)
            array.dims[dimension].attach_scale(group[label])


def pack(
    recipe: Recipe,
    split: str,
    entry: schema.Json,
    maps: schema.Maps,
    fields: schema.Fields = schema.KNOWN,
) -> bytes:
    """Return the bytes of a file with maps of one split.

    Args:
        recipe: recipe of the maps, with the dataset's id.
        split: name of the split.
        entry: manifest entry of the split, without the digest.
        maps: arrays by field, each of shape [B, *entry shape]: all fields of
            `schema.FIELDS`, and further fields of the dataset.
        fields: possible fields. Those in `maps` are stored, in the order of `fields`.
    """
    fields = {name: field for name, field in fields.items() if name in maps}
    contents = Contents(recipe.id, [recipe], {split: entry}, fields=fields)
    with h5py.File(
        "packed", "w", driver="core", backing_store=False, libver=_LIBRARY
    ) as file:
        digests = {schema.ENTRY_DIGESTS: schema.entry_digests(maps, fields)}
        _fill(file, contents, {split: [maps | digests]})
        return file.id.get_file_image()


def is_one_file(path: Path) -> bool:
    """Return whether a dataset at a path is one file instead of a folder of shards."""
    return path.suffix in (".h5", ".hdf5")


def name_of(path: Path) -> str:
    """Return the default id of a dataset at a path."""
    return path.stem if is_one_file(path) else path.name


def check_output(path: Path, overwrite: bool, names: Collection[str] = ()) -> None:
    """Check that a dataset may be written to a path.

    Args:
        path: path of the file or folder.
        overwrite: whether an existing dataset, or any file at a path of a file, may be
            replaced.
        names: names of shards that will be written to the folder. Existing files with
            these names may be damaged.

    Raises:
        ConfigError: If `path` exists and may not be replaced.
    """
    check_replaceable(path, overwrite, partial(foreign_in, names=names))


def foreign_in(path: Path, names: Collection[str] = ()) -> str:
    """Return why a path is not a dataset, as text; empty if it is.

    A folder may contain only shards and their manifest. Files in `names` are regarded
    as shards.
    """
    if is_one_file(path) or not path.is_dir():
        if is_one_file(path) == path.is_file():
            return ""
        return f"is a {'folder' if path.is_dir() else 'file'}"
    expected = set(names)
    # A manifest may be damaged if shards are next to it.
    with suppress(DatasetError):
        expected |= {file.name for file in TerrainDataset(path).files}
    files = sorted(file.name for file in path.iterdir())
    unexpected = [name for name in files if name not in expected]
    expected |= {name for name in unexpected if _is_shard(path / name)}
    if not expected.isdisjoint(files):
        expected.add(FOLDER_MANIFEST)
    for name in files:
        if name not in expected:
            return f"contains {name}"
    return ""


def _is_shard(file: Path) -> bool:
    """Return whether a file is a shard of any dataset, or an unfinished file."""
    if _PARTIAL.fullmatch(file.name):
        return True
    try:
        return bool(_SHARD.fullmatch(file.name) and read_manifest(file))
    except DatasetError:
        return False


def assemble(contents: Contents, folder: Path, out: Path) -> None:
    """Assemble a dataset from files that are datasets themselves.

    Args:
        contents: contents of the dataset. If `out` is a folder, the contents' files lie
            in `folder`.
        folder: `out`, or a folder that replaces `out`; unused if `out` is a file.
        out: path of the file or folder to write.

    Raises:
        ConfigError: If the folder to be replaced contains files of another program.
    """
    if is_one_file(out):
        _join(out, contents)
        return
    digests: dict[str, ndarray] = {}
    shards: dict[str, list[schema.Json]] = {}
    for split, files in contents.files.items():
        entries = [source[schema.ENTRY_DIGESTS][:] for source in _opened(split, files)]
        digests[split] = np.concatenate(entries)
        shards[split] = [
            {"file": path.name, "maps": len(file_digests)}
            for path, file_digests in zip(files, entries, strict=True)
        ]
    manifest = contents.manifest(digests)
    version = max(manifest["format_version"], FOLDER_FORMAT_VERSION)
    manifest |= {"format_version": version, "shards": shards}
    write_text(folder / FOLDER_MANIFEST, seal(manifest))
    if folder != out:
        check_output(out, True)  # another program may have added files meanwhile
        replace_folder(folder, out)


def _opened(split: str, files: Iterable[Path]) -> Iterator[h5py.Group]:
    """Yield the group of a split in each file; close each file before the next."""
    for path in files:
        with open_file(path) as file:
            yield file[split]


def _join(path: Path, contents: Contents) -> None:
    """Write a dataset of one file from the files of its contents."""
    files = [file for paths in contents.files.values() for file in paths]
    n_maps = sum(entry["maps"] for entry in contents.splits.values())
    n_bytes = sum(file.stat().st_size for file in files)
    n_bytes += _SPARE_BYTES + _SPARE_BYTES_PER_MAP * n_maps
    sources = {split: _opened(split, paths) for split, paths in contents.files.items()}
    with replacing(path) as unfinished:
        with h5py.File(unfinished, "w", libver=_LIBRARY) as file:
            # HDF5 crashes on a full disk, so space is allocated before writing.
            if hasattr(os, "posix_fallocate"):
                with open(unfinished, "rb+") as raw:
                    os.posix_fallocate(raw.fileno(), 0, n_bytes)
            _fill(file, contents, sources)
            size = file.id.get_filesize()
        os.truncate(unfinished, size)
        if path.exists():
            shutil.copymode(path, unfinished)


@contextmanager
def named_errors(path: Path) -> Iterator[None]:
    """Convert errors of writing a dataset to errors that name its path.

    Raises:
        DatasetError: If the system or HDF5 could not write.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise out_of_memory_error(error) or DatasetError(
            f"Could not write {path}: {reason}. Remove the cause, then run the same "
            "command again."
        ) from error


@contextmanager
def exclusive_output(
    out: Path, overwrite: bool, foreign: Callable[[Path], str] = foreign_in
) -> Iterator[None]:
    """Reserve an output path for this process, after a check; convert write errors.

    Args:
        out: output path.
        overwrite: whether to replace existing output.
        foreign: returns why a path must not be replaced; empty if it may be.

    Raises:
        ConfigError: If `out` exists and may not be replaced; see `check_replaceable`.
        DatasetError: If writing fails; see `named_errors`.
    """
    with named_errors(out), sole_writer(out, str(out)):
        restore(out)
        check_replaceable(out, overwrite, foreign)
        yield


def _put(source: ndarray | h5py.Dataset, target: h5py.Dataset, first: int) -> None:
    """Write maps to consecutive indices from `first`.

    If source and target are files with the same filters and one map per chunk, chunks
    are copied without decompression.
    """
    if isinstance(source, ndarray) or target.chunks[0] > 1:
        target[first : first + len(source)] = source[:]
        return
    if _storage_of(source) != _storage_of(target):
        target[first : first + len(source)] = source[:]
        return
    within = (0,) * (source.ndim - 1)
    for index in range(len(source)):
        mask, chunk = source.id.read_direct_chunk((index, *within))
        target.id.write_direct_chunk((first + index, *within), chunk, mask)


def _storage_of(array: h5py.Dataset) -> tuple[object, ...]:
    """Return the properties in which two arrays must agree to copy chunks.

    The level of deflate is not among them.
    """
    return (
        array.dtype.str,
        array.chunks,
        array.shuffle,
        array.compression,
        array.fletcher32,
    )
