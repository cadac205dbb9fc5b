"""Finds datasets: by path, by id in folders of datasets, or on a hub."""

from pathlib import Path

from benchnav.core import hub
from benchnav.core.errors import DatasetError
from benchnav.core.shipped_files import shipped_folder
from benchnav.datagen.files.manifest import FOLDER_MANIFEST, is_dataset


def dataset_folders() -> list[Path]:
    """Where datasets are looked for by id: `datasets/` here, and the shipped ones."""
    here, shipped = Path("datasets"), shipped_folder("datasets")
    return [here] if here.resolve() == shipped.resolve() else [here, shipped]


def find_dataset(source: str | Path) -> Path:
    """Finds a dataset by path, by id in `dataset_folders`, or on a hub by
    `owner/name@revision`.

    Raises:
        DatasetError: none of them is there.
    """
    if is_dataset(Path(source)) or any(Path(source).glob("*.h5")):
        return Path(source)  # of shards without a manifest the reader tells what to do
    for folder in dataset_folders():
        for name in (f"{source}.h5", f"{source}", f"{source}-test.h5"):
            if is_dataset(folder / name):
                return folder / name
    if hub.is_address(source):
        return _in_snapshot(
            hub.download(str(source), "dataset", DatasetError), str(source)
        )
    raise DatasetError(
        f"Expected the path or id of a dataset, got {str(source)!r}, which is neither "
        "a file nor in "
        f"{' or '.join(map(str, dataset_folders()))}. Make one with `benchnav-datagen "
        "create`."
    )


def _in_snapshot(folder: Path, source: str) -> Path:
    """The dataset in what was downloaded: a folder of shards, or its one file."""
    if (folder / FOLDER_MANIFEST).is_file():
        return folder
    files = sorted(folder.glob("*.h5"))
    if len(files) != 1:
        raise DatasetError(
            f"Expected {source} to hold {FOLDER_MANIFEST} and its shards, or one file "
            f".h5, got {len(files)} files .h5. "
            "Name another repository or revision."
        )
    return files[0]
