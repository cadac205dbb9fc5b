"""Writing datasets (HDF5), whole or not at all: a file, or a folder of such files with
one manifest.

HDF5's own filters compress and checksum: byte shuffle, deflate, Fletcher-32. Letters in
shapes: B maps.
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
from benchnav.core.errors import DatasetError, out_of_memory
from benchnav.core.store import (
    refuse_taken,
    replacing,
    restore,
    seal,
    sole_writer,
    take_place,
    write_text,
)
from benchnav.datagen import schema
from benchnav.datagen.files.manifest import FOLDER_MANIFEST, open_file, read_manifest
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import Recipe

FOLDER_FORMAT_VERSION = "1.2"  # at least

# Structures of HDF5 1.10 carry checksums of their own, so that damage to them is found
# as well.
_LIBRARY = ("v110", "v110")

_VALUES_A_CHUNK = 1024
# Room for what is not maps: HDF5's structures, small fields, digests, manifest.
_SPARE_BYTES = 1 << 18
_SPARE_BYTES_A_MAP = 1024

_SHARD = re.compile(r".+-\d{8}-\d{8}\.h5")
_HALF = re.compile(r"\..+\.partial")  # of a shard or of the manifest

# stored arrays, or those to be stored, by name, `ENTRY_DIGESTS` among them
Source = Mapping[str, Any]


class Contents(NamedTuple):
    """What a dataset is to hold, and the files that hold it.

    Args:
        id: name and version of the dataset.
        recipes: what the splits' parts refer to by number. The first gives grid and
            class table.
        splits: by name, the manifest's entry of each split without its digest.
        files: by split the files that hold its maps, in their order, each under the
            split's name.
        fields: what every map has.
    """

    id: str
    recipes: Sequence[Recipe]
    splits: Mapping[str, schema.Json]
    files: Mapping[str, Sequence[Path]] = {}
    fields: schema.Fields = schema.FIELDS

    def manifest(self, entry_digests: Mapping[str, ndarray]) -> schema.Json:
        """The manifest, by the digests of all maps' entries, `schema.entry_digests`, of
        each split.
        """
        recipes, shape = (
            [recipe.to_dict() for recipe in self.recipes],
            self.recipes[0].grid.shape,
        )
        return {
            "format": schema.FORMAT,
            "format_version": schema.version_of(
                recipes, self.splits.values(), self.fields
            ),
            "id": self.id,
            "generator": {"package": "benchnav", "version": benchnav.__version__},
            "fields": schema.field_table(*shape, self.fields),
            "splits": {
                name: {
                    **entry,
                    "digest": schema.split_digest(
                        entry_digests[name], *shape, self.fields
                    ),
                }
                for name, entry in self.splits.items()
            },
            "recipes": recipes,
        }


class ShardFile(NamedTuple):
    """Consecutive maps of a recipe's split, in a file that is a dataset by itself: from
    one on, to before another.
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
        """Name of its file."""
        return f"{self.split.replace('/', '+')}-{self.first:08d}-{self.stop:08d}.h5"


def whole(recipe: Recipe, files: Mapping[str, Sequence[Path]]) -> Contents:
    """All maps of a recipe, by split the files that hold them."""
    splits = {
        name: recipe_entry(recipe, ShardFile(name, 0, spec.maps))
        for name, spec in recipe.splits.items()
    }
    return Contents(recipe.id, [recipe], splits, files, recipe.fields)


def recipe_entry(recipe: Recipe, shard: ShardFile) -> schema.Json:
    """The manifest's entry of consecutive maps of a recipe's split, without their
    digest.
    """
    part = {"maps": shard.maps, "recipe": 0, "split": shard.split, "first": shard.first}
    return {
        "scenario": recipe.splits[shard.split].scenario,
        "maps": shard.maps,
        "parts": [part],
    }


def _fill(
    file: h5py.File, contents: Contents, sources: Mapping[str, Iterable[Source]]
) -> None:
    """Fills an empty file with a dataset: with all arrays of each split's sources, end
    to end.
    """
    kinds = schema.stored_arrays(contents.fields, *contents.recipes[0].grid.shape)
    # Made at first and kept until all is written: HDF5 writes an array out when it is
    # let go.
    arrays: dict[str, dict[str, h5py.Dataset]] = {
        split: {} for split in contents.splits
    }
    for split, own in arrays.items():
        group, maps = file.create_group(split), contents.splits[split]["maps"]
        for name, (dtype, entry) in kinds.items():
            field = contents.fields.get(name)
            # Of cells, a map a chunk.
            chunk = (
                1
                if field and "H" in field.shape
                else max(1, min(maps, _VALUES_A_CHUNK))
            )
            own[name] = group.create_dataset(
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
                own[name].attrs.update(unit=field.unit, meaning=field.meaning)
        _add_scales(group, contents)
    for split, several in sources.items():
        first = 0
        for source in several:
            for name, target in arrays[split].items():
                _put(source[name], target, first)
            first += len(source[schema.ENTRY_DIGESTS])
    digests = {split: own[schema.ENTRY_DIGESTS][:] for split, own in arrays.items()}
    text = seal(contents.manifest(digests)).encode()
    file.create_dataset(
        schema.MANIFEST, data=text, dtype=h5py.string_dtype("utf-8", len(text))
    )
    file.flush()


def _add_scales(group: h5py.Group, contents: Contents) -> None:
    """Name the dimensions of a split's arrays by HDF5 dimension scales: map_index, y_m,
    x_m, and axis_N of N others.
    """
    recipe = contents.recipes[0]
    for name, array in list(group.items()):
        shape = (
            contents.fields[name].shape if name in contents.fields else array.shape[1:]
        )
        labels = ({"H": "y_m", "W": "x_m"}.get(str(n), f"axis_{n}") for n in shape)
        for at, label in enumerate(("map_index", *labels)):
            if label in contents.fields:
                continue
            if label not in group:
                values = np.arange(array.shape[at])
                if label in ("y_m", "x_m"):
                    values = recipe.resolution_m * (values + 0.5)
                group.create_dataset(label, data=values, fletcher32=True)
                group[label].make_scale(label)
            array.dims[at].attach_scale(group[label])


def pack(
    recipe: Recipe,
    split: str,
    entry: schema.Json,
    maps: schema.Maps,
    fields: schema.Fields = schema.KNOWN,
) -> bytes:
    """Makes what a file of a few maps of one split holds, in memory.

    Args:
        recipe: by which they were made, with the dataset's id.
        split: name of the split.
        entry: the manifest's entry of the split without its digest.
        maps: every field of `schema.FIELDS`, and others that the dataset has, of shape
            [B, *entry shape].
        fields: what maps may have; those that they have are stored, in this order.
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
    """Whether a dataset of this name is one file; else it is a folder of shards."""
    return path.suffix in (".h5", ".hdf5")


def name_of(path: Path) -> str:
    """What a dataset at a place is called where nobody says."""
    return path.stem if is_one_file(path) else path.name


def check_place(path: Path, overwrite: bool, names: Collection[str] = ()) -> None:
    """Refuses a place for a dataset that is taken.

    Args:
        path: file or folder.
        overwrite: whether a dataset, or any file of this name, may be replaced.
        names: of shards that are to be made in the folder, which may be damaged.

    Raises:
        ConfigError: it is.
    """
    refuse_taken(path, overwrite, partial(foreign_in, names=names))


def foreign_in(path: Path, names: Collection[str] = ()) -> str:
    """Says what of another kind a place holds; a folder may hold shards and their
    manifest alone.
    """
    if is_one_file(path) or not path.is_dir():
        return (
            ""
            if is_one_file(path) == path.is_file()
            else f"is a {'folder' if path.is_dir() else 'file'}"
        )
    ours = set(names)
    with suppress(DatasetError):  # a damaged manifest is one where shards lie beside it
        ours |= {file.name for file in TerrainDataset(path).files}
    files = sorted(file.name for file in path.iterdir())
    ours |= {name for name in files if name not in ours and _is_shard(path / name)}
    for name in files:
        if name not in ours and not (name == FOLDER_MANIFEST and ours & set(files)):
            return f"holds {name}"
    return ""


def _is_shard(file: Path) -> bool:
    """Tells whether a file is a shard, of whatever dataset, or what is half-written of
    one.
    """
    try:
        return bool(
            _HALF.fullmatch(file.name)
            or (_SHARD.fullmatch(file.name) and read_manifest(file))
        )
    except DatasetError:
        return False


def assemble(contents: Contents, folder: Path, out: Path) -> None:
    """Makes a dataset of files, each of which is one by itself.

    Args:
        contents: what it holds. For a folder all files lie in `folder`.
        folder: beside `out`, whose place it takes; or `out` itself. Of a file it
            changes nothing.
        out: file or folder.

    Raises:
        ConfigError: something else has come to be in the folder that is replaced.
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
            {"file": path.name, "maps": len(own)}
            for path, own in zip(files, entries, strict=True)
        ]
    manifest = contents.manifest(digests)
    version = max(manifest["format_version"], FOLDER_FORMAT_VERSION)
    write_text(
        folder / FOLDER_MANIFEST,
        seal(manifest | {"format_version": version, "shards": shards}),
    )
    if folder != out:
        check_place(out, True)  # others may have put something there meanwhile
        take_place(folder, out)


def _opened(split: str, files: Iterable[Path]) -> Iterator[h5py.Group]:
    """What files hold of a split, each open while it is used."""
    for path in files:
        with open_file(path) as file:
            yield file[split]


def _join(path: Path, contents: Contents) -> None:
    """Writes one file of many."""
    stored = sum(
        file.stat().st_size for files in contents.files.values() for file in files
    )
    maps = sum(entry["maps"] for entry in contents.splits.values())
    with replacing(path) as unfinished:
        with h5py.File(unfinished, "w", libver=_LIBRARY) as file:
            # HDF5 crashes if it meets a full disk, so room is taken ahead of it.
            if hasattr(os, "posix_fallocate"):
                with open(unfinished, "rb+") as raw:
                    os.posix_fallocate(
                        raw.fileno(),
                        0,
                        stored + _SPARE_BYTES + _SPARE_BYTES_A_MAP * maps,
                    )
            _fill(
                file,
                contents,
                {split: _opened(split, own) for split, own in contents.files.items()},
            )
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
        yield
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise out_of_memory(error) or DatasetError(
            f"Could not write {path}: {reason}. When that is mended, give the same "
            "command again."
        ) from error


@contextmanager
def held(
    out: Path, overwrite: bool, foreign: Callable[[Path], str] = foreign_in
) -> Iterator[None]:
    """Holds the place of what is made whole, for one process; see `refuse_taken` and
    `named_errors`.
    """
    with named_errors(out), sole_writer(out, str(out)):
        restore(out)
        refuse_taken(out, overwrite, foreign)
        yield


def _put(source: ndarray | h5py.Dataset, target: h5py.Dataset, first: int) -> None:
    """Writes maps as those from one on; stored ones that are packed alike, a map a
    chunk, are not unpacked.
    """
    if (
        target.chunks[0] > 1
        or isinstance(source, ndarray)
        or _packing(source) != _packing(target)
    ):
        target[first : first + len(source)] = source[:]
        return
    within = (0,) * (source.ndim - 1)
    for index in range(len(source)):
        mask, chunk = source.id.read_direct_chunk((index, *within))
        target.id.write_direct_chunk((first + index, *within), chunk, mask)


def _packing(array: h5py.Dataset) -> tuple[object, ...]:
    """What has to be alike for a chunk of one array to be one of another; the level of
    deflate need not be.
    """
    return (
        array.dtype.str,
        array.chunks,
        array.shuffle,
        array.compression,
        array.fletcher32,
    )
