"""Lookup of datasets by path, by id in folders of datasets, or on a hub."""

from pathlib import Path

from benchnav.core import hub
from benchnav.core.errors import DatasetError
from benchnav.core.shipped_files import shipped_folder
from benchnav.datagen.files.manifest import FOLDER_MANIFEST, is_dataset


def dataset_folders() -> list[Path]:
    """Return the folders in which ids are looked up: `datasets/`, and the shipped one."""
    local = Path("datasets")
    shipped = shipped_folder("datasets")
    return [local] if local.resolve() == shipped.resolve() else [local, shipped]


def find_dataset(source: str | Path) -> Path:
    """Return the path of a dataset.

    Args:
        source: path, id in `dataset_folders`, or `owner/name@revision` on a hub.

    Raises:
        DatasetError: If there is no such dataset.
    """
    if is_dataset(Path(source)) or any(Path(source).glob("*.h5")):
        # The reader's error explains how to finish shards without a manifest.
        return Path(source)
    for folder in dataset_folders():
        for name in (f"{source}.h5", f"{source}", f"{source}-test.h5"):
            if is_dataset(folder / name):
                return folder / name
    if hub.is_address(source):
        snapshot = hub.download(str(source), "dataset", DatasetError)
        return _in_snapshot(snapshot, str(source))
    folders = " or ".join(map(str, dataset_folders()))
    raise DatasetError(
        f"Expected the path or id of a dataset, got {str(source)!r}, which is neither "
        f"a file nor in {folders}. Make one with `benchnav-datagen create`."
    )


def _in_snapshot(folder: Path, source: str) -> Path:
    """Return the dataset in a download: a folder of shards, or its only file."""
    if (folder / FOLDER_MANIFEST).is_file():
        return folder
    files = sorted(folder.glob("*.h5"))
    if len(files) != 1:
        raise DatasetError(
            f"Expected {source} to contain {FOLDER_MANIFEST} and its shards, or one file "
            f".h5, got {len(files)} files .h5. Name another repository or revision."
        )
    return files[0]
