"""Creation of datasets: shard by shard, in parallel, resumed after an interruption.

A shard is a file of consecutive maps of a split. It depends only on the recipe and the
indices of the maps, so any process on any machine may generate it, and lost shards can
be generated again. If a dataset is a single file, its shards are written to the folder
`.NAME.partial` next to the file and joined at the end. If a dataset is a folder, its
shards are written to this folder, and the dataset is finished when its manifest is
written. If the folder replaces a finished dataset, its shards are first written to
`.NAME.partial` too.
"""

import platform
import shutil
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np

import benchnav
from benchnav.core.errors import ConfigError, DatasetError, expect
from benchnav.core.store import Shard, replacing, resolve_link, restore, sole_writer
from benchnav.core.workers import run_calls
from benchnav.datagen.files.hdf5 import (
    ShardFile,
    assemble,
    check_output,
    contents_of_recipe,
    is_one_file,
    named_errors,
    pack,
    recipe_entry,
)
from benchnav.datagen.files.manifest import FOLDER_MANIFEST, read_manifest
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.synth.generate import generate

SHARD_CELLS = 2**20


def create(
    recipe: Recipe,
    path: Path,
    jobs: int = 1,
    scheduler: str = "",
    shard: Shard | None = None,
    overwrite: bool = False,
    shard_cells: int = SHARD_CELLS,
) -> Iterator[tuple[int, int]]:
    """Create a dataset; yield (maps done, total maps). Iterate to the end.

    The first pair is yielded before any map is generated and counts existing maps.

    Args:
        recipe: recipe of the dataset.
        path: path of the file to write, if its suffix is `.h5` or `.hdf5`; else path of
            the folder to write.
        jobs: number of processes that generate maps.
        scheduler: address of the scheduler of a Dask cluster, whose workers then
            generate the maps; empty for no cluster.
        shard: part of the dataset's shards to generate; None for all.
        overwrite: whether to replace an existing dataset.
        shard_cells: maximum number of cells of a shard with several maps; does not
            affect a single file.

    Raises:
        DatasetError: If the dataset cannot be written, or workers have another version
            of this package.
        ConfigError: If the recipe yields no valid maps, `path` exists, or the cluster
            cannot be reached.
        BenchnavError: If another process is writing the dataset, a worker was killed,
            or the connection to the cluster was lost.
    """
    path = resolve_link(path)
    expect(
        shard is None or not is_one_file(path),
        "`out` to be a folder if `shard` is given, got the name of a single file, "
        f"{path}. A shard is only part of a dataset. Leave out the suffix.",
    )
    for spec in recipe.layers if jobs > 1 or scheduler else ():
        spec.check_workers()
    size = recipe.grid.maps_in(shard_cells)
    shards = [
        ShardFile(split, first, min(first + size, spec.maps))
        for split, spec in recipe.splits.items()
        for first in range(0, spec.maps, size)
    ]
    requested = shards
    locked = path
    if shard is not None:
        # Several processes may write to the folder, each a different part of the
        # shards.
        requested = shards[shard.index - 1 :: shard.of]
        locked = path.with_name(f"{path.name}.{shard.index}-of-{shard.of}")
    with (
        named_errors(path),
        sole_writer(path, str(path), shared=True) if shard else nullcontext(),
        sole_writer(locked, str(path)),
    ):
        restore(path)
        # A folder may contain shards of this recipe from an interrupted run.
        names = [file.name for file in shards]
        check_output(path, overwrite or not is_one_file(path), names)
        folder = path
        if is_one_file(path) or (overwrite and (path / FOLDER_MANIFEST).exists()):
            expect(
                shard is None,
                f"no finished dataset at `out` if `shard` is given, got {path}. Remove "
                "the dataset first.",
            )
            folder = path.with_name(f".{path.name}.partial")
        folder.mkdir(parents=True, exist_ok=True)
        may_replace = overwrite or folder != path
        missing = _missing(folder, recipe, shards, requested, may_replace=may_replace)
        manifest = folder / FOLDER_MANIFEST
        if manifest.exists() and not missing:
            check_output(path, overwrite)
        manifest.unlink(missing_ok=True)  # the dataset is unfinished until the end
        total = sum(file.maps for file in requested)
        n_existing = total - sum(file.maps for file in missing)
        done = n_existing
        yield done, total
        version = benchnav.__version__
        try:
            calls = [partial(make_shard, recipe, file, version) for file in missing]
            for file, content in run_calls(calls, jobs, scheduler):
                with replacing(folder / file.name) as unfinished:
                    unfinished.write_bytes(content)
                done += file.maps
                yield done, total
        except ConfigError:
            # If this run generated maps before the error, the recipe is the cause, so
            # the shards are of no use.
            if folder != path and (done > n_existing or not any(folder.iterdir())):
                shutil.rmtree(folder, ignore_errors=True)
            raise
        if shard is None or not _missing(
            folder, recipe, shards, (), may_replace=overwrite
        ):
            files: dict[str, list[Path]] = {name: [] for name in recipe.splits}
            for file in shards:
                files[file.split].append(folder / file.name)
            assemble(contents_of_recipe(recipe, files), folder, path)
            if is_one_file(path):
                shutil.rmtree(folder)


def make_shard(
    recipe: Recipe, shard: ShardFile, version: str
) -> tuple[ShardFile, bytes]:
    """Generate a shard. The function may run on another machine.

    Args:
        recipe: recipe of the maps.
        shard: shard to generate.
        version: expected version of this package.

    Returns:
        The shard, and the bytes of its file.

    Raises:
        DatasetError: If another version of this package is running.
        ConfigError: If the recipe yields no valid maps.
    """
    if benchnav.__version__ != version:
        raise DatasetError(
            f"Expected workers with benchnav {version}, got a worker on "
            f"{platform.node()} with {benchnav.__version__}. Install the same version."
        )
    maps = generate(recipe, shard.split, np.arange(shard.first, shard.stop))
    entry = recipe_entry(recipe, shard)
    return shard, pack(recipe, shard.split, entry, maps, recipe.fields)


def is_current(path: Path, recipe: Recipe, shard: ShardFile) -> bool:
    """Return whether a file is a shard of a recipe by this version of the package."""
    try:
        manifest = read_manifest(path)
    except DatasetError:
        return False
    entry = recipe_entry(recipe, shard)
    return (
        manifest["recipes"] == [recipe.to_dict()]
        and manifest["generator"]["version"] == benchnav.__version__
        and entry.items() <= manifest["splits"].get(shard.split, {}).items()
    )


def _missing(
    folder: Path,
    recipe: Recipe,
    shards: Sequence[ShardFile],
    requested: Sequence[ShardFile],
    may_replace: bool,
) -> list[ShardFile]:
    """Return the missing shards, and remove the outdated files that they replace.

    Files are outdated if their recipe, shard size or version differs.

    Args:
        folder: folder of the shards.
        recipe: recipe of the dataset.
        shards: all shards of the dataset.
        requested: shards that this process generates. If empty, all shards are checked,
            and no file is removed.
        may_replace: whether outdated files are allowed.

    Raises:
        ConfigError: If outdated files exist and are not allowed.
    """
    by_name = {shard.name: shard for shard in shards}
    current: set[str] = set()
    outdated: list[Path] = []
    for file in sorted(folder.glob("*.h5")):
        shard = by_name.get(file.name)
        if shard is not None and is_current(file, recipe, shard):
            current.add(file.name)
        else:
            outdated.append(file)
    for file in outdated:
        expect(
            may_replace,
            "`out` to be new or to contain only shards of this recipe, these settings "
            f"and this version, got {file}, which differs. Choose another `out`, use "
            "the recipe, settings and version of that file, or pass --overwrite to "
            "replace it.",
        )
    requested_names = {shard.name for shard in requested}
    # Outdated shards of other processes are left, since those processes replace them.
    replaced = [
        file
        for file in outdated
        if file.name in requested_names or file.name not in by_name
    ]
    # An interrupted run may have left partial files of requested shards.
    partial_files = [
        file
        for file in folder.glob(".*.partial")
        if any(f".{name}." in file.name for name in requested_names)
    ]
    if requested:
        for file in replaced + partial_files:
            file.unlink(missing_ok=True)
    return [shard for shard in requested or shards if shard.name not in current]
