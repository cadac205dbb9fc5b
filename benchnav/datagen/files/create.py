"""Making datasets: shard by shard, in parallel, gone on with after a kill.

A dataset of one file is made in the folder `.NAME.partial` beside it, whose shards are joined at the end. One
of many files is made where it is to be, and is finished when its manifest is written; where it replaces a finished
one it is made in such a folder too.
"""

import platform
import re
import shutil
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import benchnav
from benchnav.core.errors import ConfigError, DatasetError
from benchnav.core.store import Shard, real_place, restore, sole_writer, take_place
from benchnav.core.workers import run_calls
from benchnav.datagen.files.folder import Contents, whole, write_manifest
from benchnav.datagen.files.hdf5 import check_target, is_one_file, named_errors, writing
from benchnav.datagen.files.reader import FOLDER_MANIFEST, is_dataset, open_file, read_manifest
from benchnav.datagen.files.shard import SHARD_CELLS, ShardFile, cut, is_there, make, write
from benchnav.datagen.recipe.recipe import Recipe

_SHARD = re.compile(r".+-\d{8}-\d{8}\.h5")
_HALF = re.compile(r"\..+\.partial")  # of a shard or of the manifest


def create(
    recipe: Recipe,
    path: Path,
    jobs: int = 1,
    scheduler: str = "",
    shard: Shard | None = None,
    overwrite: bool = False,
    shard_cells: int = SHARD_CELLS,
) -> Iterator[tuple[int, int]]:
    """Makes a dataset, yielding (maps done, maps in all) as it goes; to be iterated to the end.

    What comes first is told before anything is made: the maps that are there already, and those in all.

    Args:
        recipe: what to make.
        path: file to write, of suffix `.h5` or `.hdf5`; else a folder.
        jobs: processes to make maps in.
        scheduler: address of a Dask cluster's scheduler, whose workers take their place; empty for none.
        shard: which of the shards are made here; None for all.
        overwrite: replace what is there.
        shard_cells: cells of a shard; of a single file it changes nothing.

    Raises:
        DatasetError: the dataset exists, another run is writing it, or it cannot be written.
        ConfigError: the recipe cannot be met.
    """
    shards = cut(recipe, shard_cells)
    own = [file for place, file in enumerate(shards) if shard is None or place % shard.of == shard.index - 1]
    path = real_place(path)
    names = {shard.name for shard in shards}
    is_file = is_one_file(path)
    if is_file and shard is not None:
        raise ConfigError(f"Expected `out` to be a folder, since a shard is made, got {path}.")
    with named_errors(path), _held(path, shard):
        restore(path)
        folder = _workplace(path, recipe, names, shard, overwrite)
        missing = _missing(recipe, folder, shards, own, may_replace=overwrite or folder != path)
        if folder == path and (path / FOLDER_MANIFEST).exists():
            if not missing:
                raise DatasetError(
                    f"Expected `out` to be a new folder, but {path} exists. Pass --overwrite to replace it."
                )
            (path / FOLDER_MANIFEST).unlink()  # until what was lost is there again
        total = sum(shard.maps for shard in own)
        done = total - sum(shard.maps for shard in missing)
        yield done, total
        calls = [partial(_make, recipe, file, benchnav.__version__) for file in missing]
        with _left_nothing(folder, path):
            for file, content in run_calls(calls, jobs, scheduler if missing else ""):
                write(folder / file.name, content)
                done += file.maps
                yield done, total
        if not _are_all_there(folder, recipe, shards, overwrite):
            return  # the other shards are made elsewhere
        files = {
            name: [folder / shard.name for shard in shards if shard.split == name] for name in recipe.splits
        }
        contents = whole(recipe, files)
        if is_file:
            join(path, contents)
            shutil.rmtree(folder)
            return
        write_manifest(folder, contents)
        if folder != path:
            check_folder(path, names)  # others may have put something there meanwhile
            take_place(folder, path)


def join(path: Path, contents: Contents) -> None:
    """Writes one file of many.

    Args:
        path: file to write or replace.
        contents: what it is to hold.
    """
    room = sum(file.stat().st_size for files in contents.files.values() for file in files)
    with writing(path, contents.id, contents.recipes, contents.splits, contents.fields, room) as writer:
        for split, files in contents.files.items():
            for file in files:
                with open_file(file) as stored:
                    writer.copy(split, stored[split])


@contextmanager
def _held(path: Path, shard: Shard | None) -> Iterator[None]:
    """Holds the dataset for one process, or a shard of it: several may be made at once."""
    with sole_writer(path, str(path), shared=shard is not None):
        if shard is None:
            yield
            return
        name = f"{path.name}.{shard.index}-of-{shard.of}"
        with sole_writer(path.with_name(name), str(path)):
            yield


def _workplace(
    path: Path, recipe: Recipe, names: Collection[str], shard: Shard | None, overwrite: bool
) -> Path:
    """Where shards are made: where they are to be, or beside a file or a finished folder that they replace.

    Raises:
        DatasetError: what is there may not be replaced.
    """
    beside = path.with_name(f".{path.name}.partial")
    if is_one_file(path):
        if beside.exists() and not overwrite and _holds(path, recipe):
            shutil.rmtree(beside)  # of a run that was killed when it had joined them
        check_target(path, overwrite)
        return beside
    check_folder(path, names)
    if not overwrite or not (path / FOLDER_MANIFEST).exists():
        return path
    if shard is not None:
        raise DatasetError(
            f"Expected no finished dataset to replace by a shard, got {path}. Remove it first."
        )
    return beside


def _missing(
    recipe: Recipe, folder: Path, shards: Sequence[ShardFile], own: Sequence[ShardFile], may_replace: bool
) -> list[ShardFile]:
    """Which shards are to be made; those of another recipe, cut or version are removed where they may be.

    Raises:
        DatasetError: there are such, and they may not be.
    """
    folder.mkdir(parents=True, exist_ok=True)
    known = {shard.name: shard for shard in shards}
    every = sorted(folder.glob("*.h5"))
    there = [file for file in every if file.name in known and is_there(file, recipe, known[file.name])]
    foreign = [file for file in every if file not in there]
    if foreign and not may_replace:
        raise DatasetError(
            f"Expected `out` to be new or to hold shards of this recipe and version, but {foreign[0]} is another. "
            "Choose another `out`, or pass --overwrite."
        )
    # Those of other shards are for these to replace.
    mine = {shard.name for shard in own}
    dropped = [file for file in foreign if file.name in mine or file.name not in known]
    # What is half-written of this shard is of a killed run.
    half = [file for file in folder.glob(".*.partial") if any(f".{name}." in file.name for name in mine)]
    for file in (*dropped, *half):
        file.unlink(missing_ok=True)
    return [shard for shard in own if folder / shard.name not in there]


def _are_all_there(folder: Path, recipe: Recipe, shards: Sequence[ShardFile], overwrite: bool) -> bool:
    """Tells whether every shard is there, of this recipe and version.

    Raises:
        DatasetError: one is of another, and no run is on its way to replace it.
    """
    missing = [shard.name for shard in shards if not is_there(folder / shard.name, recipe, shard)]
    foreign = [name for name in missing if (folder / name).exists()]
    if foreign and not overwrite:
        raise DatasetError(
            f"Expected all shards of one recipe and version, but {folder / foreign[0]} is of another. "
            "Make its shard anew with --overwrite, by the recipe, settings and version of the others."
        )
    return not missing


def _holds(path: Path, recipe: Recipe) -> bool:
    """Tells whether a file is a dataset of the whole of this recipe."""
    try:
        return path.exists() and read_manifest(path)["recipes"] == [recipe.to_dict()]
    except DatasetError:
        return False


def check_place(path: Path, overwrite: bool) -> None:
    """Refuses a target of what is made elsewhere: one that is there, unless it is a dataset to be replaced.

    Raises:
        DatasetError: it is there and `overwrite` is false, or it holds anything but a dataset.
    """
    if is_one_file(path):
        check_target(path, overwrite)
        return
    check_folder(path)
    if path.exists() and any(path.iterdir()) and not overwrite:
        raise DatasetError(
            f"Expected `out` to be a new folder, but {path} exists. Pass --overwrite to replace it."
        )


def check_folder(path: Path, names: Collection[str] = ()) -> None:
    """Refuses a folder that holds anything but shards and their manifest, which no option may remove.

    Args:
        path: the folder, if there is one.
        names: of shards that are to be made there, which may be damaged.

    Raises:
        DatasetError: it does, or `path` is a file.
    """
    if path.exists() and not path.is_dir():
        raise DatasetError(f"Expected `out` to be a folder or a file .h5, got the file {path}.")
    there = sorted(path.iterdir()) if path.exists() else []
    known = {*names, *_listed(path)}
    for file in there:
        if file.name not in known and not _is_ours(file):
            raise DatasetError(
                f"Expected `out` to be a new folder or one of shards, but {path} holds {file.name}."
            )


def _listed(path: Path) -> set[str]:
    """Names in a folder's manifest, its own among them; of a damaged one its own alone, where shards lie beside it."""
    try:
        shards = read_manifest(path).get("shards", {}) if is_dataset(path) else {}
    except DatasetError:
        return {FOLDER_MANIFEST} if any(_SHARD.fullmatch(file.name) for file in path.iterdir()) else set()
    listed = {shard["file"] for own in shards.values() for shard in own}
    return {FOLDER_MANIFEST, *listed} if listed else set()


def _is_ours(file: Path) -> bool:
    """Tells whether a file is a shard, of whatever dataset, or what is half-written of one."""
    if _HALF.fullmatch(file.name):
        return True
    try:
        return bool(_SHARD.fullmatch(file.name) and read_manifest(file))
    except DatasetError:
        return False


def _make(recipe: Recipe, shard: ShardFile, version: str) -> tuple[ShardFile, bytes]:
    """Makes a shard, perhaps in a process on another machine.

    Raises:
        ConfigError: another version of this package is installed there, or the recipe cannot be met.
    """
    if benchnav.__version__ != version:
        raise ConfigError(
            f"Expected workers with benchnav {version}, got one on {platform.node()} with {benchnav.__version__}."
        )
    return shard, make(recipe, shard)


@contextmanager
def _left_nothing(folder: Path, path: Path) -> Iterator[None]:
    """Removes what was made of a file whose recipe cannot be met: there is nothing to go on to."""
    try:
        yield
    except ConfigError:
        if folder != path:
            shutil.rmtree(folder, ignore_errors=True)
        raise
