"""Writing dataset files (HDF5), whole or not at all, one writer at a time.

What is unfinished lives in the folder `.NAME.partial` beside the target, whose name never holds a
partial file.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

import benchnav
from benchnav.datagen import schema
from benchnav.datagen.files import block
from benchnav.datagen.files.block import Block
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.errors import DatasetError
from benchnav.files import sole_writer

# Room for what is not maps: HDF5's structures, small fields, digests, manifest.
_SPARE_BYTES = 1 << 18
_SPARE_BYTES_A_MAP = 512


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
    recipes: list[Recipe],
    splits: dict[str, dict[str, Any]],
    overwrite: bool = False,
) -> Iterator[Callable[[str, Block], None]]:
    """Writes a dataset file, in a workspace of its own that it leaves no trace of.

    Args:
        path: file to write or replace.
        dataset_id: name and version of the dataset.
        recipes: what the splits' parts refer to by number. The first gives grid and class table.
        splits: by name, the manifest's entry of each split without its digest.
        overwrite: replace a file that is there.

    Yields:
        A function to be given every block with the name of its split, each split's in the order of
        its maps.
    """
    with named_errors(path), workspace(path, overwrite) as folder:
        try:
            with writing_into(folder, path, dataset_id, recipes, splits) as write:
                yield write
        finally:
            # What a killed run made of the same name is not this one's to remove.
            if not any(folder.glob("*.block")):
                shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def writing_into(
    folder: Path, path: Path, dataset_id: str, recipes: list[Recipe], splits: dict[str, dict[str, Any]]
) -> Iterator[Callable[[str, Block], None]]:
    """Writes a dataset file in a folder from `workspace`; see `writing`."""
    height, width = recipes[0].grid.shape
    digests = {name: schema.SplitDigest(entry["maps"], height, width) for name, entry in splits.items()}
    written = dict.fromkeys(splits, 0)
    unfinished = folder / "unfinished.h5"
    room = _SPARE_BYTES + _SPARE_BYTES_A_MAP * sum(entry["maps"] for entry in splits.values())
    try:
        # Structures of HDF5 1.10 carry checksums of their own, so damage to them is found as well.
        with h5py.File(unfinished, "w", libver=("v110", "v110")) as file, open(unfinished, "rb+") as raw:
            _reserve(raw.fileno(), room)
            arrays = {
                name: block.new_split(file, name, entry["maps"], height, width)
                for name, entry in splits.items()
            }

            def write(split: str, made: Block) -> None:
                nonlocal room
                room += sum(len(chunk) for encoded in made.chunks.values() for chunk in encoded)
                _reserve(raw.fileno(), room)
                block.write(arrays[split], written[split], made)
                digests[split].update(made.digests)
                written[split] += len(made)

            yield write
            assert written == {name: entry["maps"] for name, entry in splits.items()}
            manifest = {
                "format": schema.FORMAT,
                "format_version": schema.version_of([recipe.synthesis for recipe in recipes]),
                "id": dataset_id,
                "generator": {"package": "benchnav", "version": benchnav.__version__},
                "fields": schema.field_table(height, width),
                "splits": {
                    name: {**entry, "digest": digests[name].hexdigest()} for name, entry in splits.items()
                },
                "recipes": [recipe.to_dict() for recipe in recipes],
            }
            text = schema.seal(manifest).encode()
            file.create_dataset(schema.MANIFEST, data=text, dtype=h5py.string_dtype("utf-8", len(text)))
            file.flush()
            size = file.id.get_filesize()
        with open(unfinished, "rb+") as finished:
            finished.truncate(size)
            os.fsync(finished.fileno())
        if path.exists():
            shutil.copymode(path, unfinished)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def _reserve(descriptor: int, size: int) -> None:
    """Takes room on the disk ahead of HDF5, which crashes if it meets a full one.

    Raises:
        OSError: there is no such room.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)


@contextmanager
def workspace(path: Path, overwrite: bool) -> Iterator[Path]:
    """Holds the folder for what is unfinished of a file, for one process; a kill frees it.

    Raises:
        BenchnavError: another process holds it.
        DatasetError: the file is there, and not to be replaced.
    """
    folder = path.parent / f".{path.name}.partial"
    with sole_writer(path, str(path)):
        folder.mkdir(exist_ok=True)
        # Asked here, since another run may have finished it before this one came to hold the folder.
        if path.exists() and not overwrite:
            shutil.rmtree(folder, ignore_errors=True)
        check_target(path, overwrite)
        yield folder


@contextmanager
def named_errors(path: Path) -> Iterator[None]:
    """Tells which file could not be written.

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
            f"Could not write {path}: {reason}. Its name holds what it held before; when that is mended, "
            "give the same command again."
        ) from error
