"""Search for datasets by path, by id in folders of datasets, or on a hub."""

from pathlib import Path

from benchnav.core import hub
from benchnav.core.errors import DatasetError
from benchnav.core.shipped_files import shipped_folder
from benchnav.datagen.files.manifest import FOLDER_MANIFEST, is_dataset


def dataset_folders() -> list[Path]:
    """Return the folders that are searched for ids: `datasets/` and the shipped one."""
    local = Path("datasets")
    shipped = shipped_folder("datasets")
    return [local] if local.resolve() == shipped.resolve() else [local, shipped]


def find_dataset(source: str | Path) -> Path:
    """Return the path of a dataset.

    Args:
        source: path, id of a dataset in `dataset_folders`, or `owner/name@revision` on
            a hub.

    Raises:
        DatasetError: If the dataset does not exist.
    """
    if is_dataset(Path(source)) or any(Path(source).glob("*.h5")):
        # A folder of shards without a manifest is accepted here, since the reader's
        # error explains how to finish such a dataset.
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
        f"a dataset nor an id in {folders}. Create a dataset with `benchnav-datagen "
        "create`."
    )


def _in_snapshot(folder: Path, source: str) -> Path:
    """Return the path of the dataset in a download: the folder, or its only file."""
    if (folder / FOLDER_MANIFEST).is_file():
        return folder
    files = sorted(folder.glob("*.h5"))
    if len(files) != 1:
        raise DatasetError(
            f"Expected {source} to contain {FOLDER_MANIFEST} and its shards, or "
            f"exactly one .h5 file, got {len(files)} .h5 files. Name another "
            "repository or revision."
        )
    return files[0]
