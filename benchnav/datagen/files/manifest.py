"""Opening of dataset files, reading of manifests, and errors on damaged data."""

import errno
import json
import os
from pathlib import Path

import h5py

from benchnav.core.errors import DatasetError
from benchnav.core.store import unseal
from benchnav.core.touched import note_file
from benchnav.datagen import schema

# Error codes of a file that another program has locked.
_LOCKED = (errno.EAGAIN, errno.EACCES)
# Errors that HDF5 and h5py raise for damaged files, depending on the damage.
READ_ERRORS = (OSError, KeyError, RuntimeError, ValueError)

FOLDER_MANIFEST = "manifest.json"  # file next to the shards of a finished dataset


def is_dataset(path: Path) -> bool:
    """Return whether a path is a file, or a folder with a finished dataset."""
    return path.is_file() or (path / FOLDER_MANIFEST).is_file()


def open_file(path: Path) -> h5py.File:
    """Open a file for reading.

    Raises:
        DatasetError: If the file does not exist, is locked, is not an HDF5 file, or its
            structure is damaged.
    """
    try:
        note_file(path)
        return h5py.File(path, "r")
    except FileNotFoundError as error:
        raise DatasetError(
            f"Expected a dataset file, got {path}, which does not exist. Create it "
            "with `benchnav-datagen create`."
        ) from error
    except OSError as error:
        if "unable to lock file" in str(error):
            remedy = "Close the program that writes to it."
            if error.errno not in _LOCKED:
                remedy = (
                    "If the file system does not support locks, set "
                    "HDF5_USE_FILE_LOCKING=FALSE."
                )
            raise DatasetError(
                f"Expected a dataset file that is not locked, got {path}: "
                f"{os.strerror(error.errno or 0)}. {remedy}"
            ) from error
        raise DatasetError(
            f"Expected a readable HDF5 file, got {path}: {error}. Create it again."
        ) from error


def read_manifest(path: Path) -> schema.Json:
    """Return the checked manifest of a file or a folder.

    Raises:
        DatasetError: If the manifest is missing or damaged, or has another format or a
            newer version.
    """
    try:
        text = _manifest_text(path)
        manifest = json.loads(text)
        kind = manifest["format"]
        version = manifest["format_version"]
        numbers = tuple(map(int, version.split("."))) if kind == schema.FORMAT else ()
        if numbers and numbers <= schema.FORMAT_VERSION:
            manifest = unseal(text)
            schema.check(manifest)
            return manifest
    except (*READ_ERRORS, TypeError, AttributeError, IndexError) as error:
        raise DatasetError(
            f"The manifest of {path} is damaged: {str(error)[:200]}. Create the "
            "dataset again."
        ) from error
    if kind != schema.FORMAT:
        raise DatasetError(
            f"Expected format {schema.FORMAT!r} in {path}, got {kind!r}. Pass a file "
            "that `benchnav-datagen` created."
        )
    newest = ".".join(map(str, schema.FORMAT_VERSION))
    raise DatasetError(
        f"Expected format version at most {newest} in {path}, got {version}. Read it "
        "with a newer benchnav: pip install --upgrade benchnav."
    )


def _manifest_text(path: Path) -> str | bytes:
    if path.is_dir():
        if not is_dataset(path):
            raise DatasetError(
                f"Expected a folder with a finished dataset, got {path} without "
                f"{FOLDER_MANIFEST}. Run the command that started the dataset again, "
                "or merge its shards with `benchnav-datagen merge`."
            )
        return (path / FOLDER_MANIFEST).read_text()
    with open_file(path) as file:
        if schema.MANIFEST not in file:
            raise DatasetError(
                f"Expected a {schema.FORMAT} file with a manifest, got {path} without "
                "a manifest. Pass a file that `benchnav-datagen` created."
            )
        return file[schema.MANIFEST][()]


def damage_error(path: Path, split: str, field: str, error: Exception) -> DatasetError:
    """Return an error on a damaged field, with a remedy."""
    return DatasetError(
        f"Field {field!r} of split {split!r} in {path} is damaged: {error}. Run "
        "`benchnav-datagen validate` on the dataset, which explains how to create it "
        "again."
    )
