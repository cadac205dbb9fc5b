"""Making datasets: shard by shard, in parallel, gone on with after a kill.

A shard is a pure function of the recipe and of which maps it holds, so that any process
on any machine may make it, and one that is lost is made anew. A dataset of one file is
made in the folder `.NAME.partial` beside it, whose shards are joined at the end. One of
many files is made where it is to be, and is finished when its manifest is written;
where it replaces a finished one it is made in such a folder too.
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
from benchnav.core.store import Shard, real_place, replacing, restore, sole_writer
from benchnav.core.workers import run_calls
from benchnav.datagen.files.hdf5 import (
    ShardFile,
    assemble,
    check_place,
    is_one_file,
    named_errors,
    pack,
    recipe_entry,
    whole,
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
    """Makes a dataset, yielding (maps done, maps in all) as it goes; to be iterated to
    the end.

    What comes first is told before anything is made: the maps that are there already,
    and those in all.

    Args:
        recipe: what to make.
        path: file to write, of suffix `.h5` or `.hdf5`; else a folder.
        jobs: processes to make maps in.
        scheduler: address of a Dask cluster's scheduler, whose workers take their
            place; empty for none.
        shard: which of the shards are made here; None for all.
        overwrite: replace what is there.
        shard_cells: cells of a shard; of a single file it changes nothing.

    Raises:
        DatasetError: it cannot be written, or workers have another version of this
            package.
        ConfigError: the recipe cannot be met, `out` is taken, or the cluster cannot be
            reached.
        BenchnavError: another run is writing it, a worker was killed, or the cluster
            was lost.
    """
    path = real_place(path)
    expect(
        shard is None or not is_one_file(path),
        f"`out` to be a folder, since a shard is made, got {path}.",
    )
    for spec in recipe.layers if jobs > 1 or scheduler else ():
        spec.check_workers()
    size = recipe.grid.maps_in(shard_cells)
    shards = [
        ShardFile(split, first, min(first + size, spec.maps))
        for split, spec in recipe.splits.items()
        for first in range(0, spec.maps, size)
    ]
    own = shards if shard is None else shards[shard.index - 1 :: shard.of]
    # Of a folder several shards may be made at once, each by one process.
    held = path.with_name(f"{path.name}.{shard.index}-of-{shard.of}") if shard else path
    with (
        named_errors(path),
        sole_writer(path, str(path), shared=True) if shard else nullcontext(),
        sole_writer(held, str(path)),
    ):
        restore(path)
        # Of a folder, shards of this recipe are gone on with.
        check_place(
            path, overwrite or not is_one_file(path), [file.name for file in shards]
        )
        folder = path
        if is_one_file(path) or (overwrite and (path / FOLDER_MANIFEST).exists()):
            expect(
                shard is None,
                f"no finished dataset in place of a shard, got {path}. Remove it "
                "first.",
            )
            folder = path.with_name(f".{path.name}.partial")
        folder.mkdir(parents=True, exist_ok=True)
        missing = _missing(
            folder, recipe, shards, own, may_replace=overwrite or folder != path
        )
        manifest = folder / FOLDER_MANIFEST
        if manifest.exists() and not missing:
            check_place(path, overwrite)
        manifest.unlink(missing_ok=True)  # until what was lost is there again
        total = sum(shard.maps for shard in own)
        begun = done = total - sum(shard.maps for shard in missing)
        yield done, total
        try:
            calls = [
                partial(make, recipe, file, benchnav.__version__) for file in missing
            ]
            for file, content in run_calls(calls, jobs, scheduler):
                with replacing(folder / file.name) as unfinished:
                    unfinished.write_bytes(content)
                done += file.maps
                yield done, total
        except ConfigError:
            # Where this run made maps the recipe cannot be met, and there is nothing to
            # go on to.
            if folder != path and (done > begun or not any(folder.iterdir())):
                shutil.rmtree(folder, ignore_errors=True)
            raise
        if shard is None or not _missing(
            folder, recipe, shards, (), may_replace=overwrite
        ):
            files = {
                name: [folder / shard.name for shard in shards if shard.split == name]
                for name in recipe.splits
            }
            contents = whole(recipe, files)
            assemble(contents, folder, path)
            if is_one_file(path):
                shutil.rmtree(folder)


def make(recipe: Recipe, shard: ShardFile, version: str) -> tuple[ShardFile, bytes]:
    """Makes a shard, perhaps in a process on another machine.

    Returns:
        The shard, and what its file holds.

    Raises:
        DatasetError: another version of this package is installed there.
        ConfigError: the recipe cannot be met.
    """
    if benchnav.__version__ != version:
        raise DatasetError(
            f"Expected workers with benchnav {version}, got one on {platform.node()} "
            f"with {benchnav.__version__}."
        )
    maps = generate(recipe, shard.split, np.arange(shard.first, shard.stop))
    return shard, pack(
        recipe, shard.split, recipe_entry(recipe, shard), maps, recipe.fields
    )


def is_there(path: Path, recipe: Recipe, shard: ShardFile) -> bool:
    """Tells whether a file is this shard of this recipe, made by this version."""
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
    own: Sequence[ShardFile],
    may_replace: bool,
) -> list[ShardFile]:
    """Which shards are not there; of another recipe, cut or version those that `own`
    replaces are removed.

    Args:
        folder: where they are made.
        recipe: what is made.
        shards: all of them.
        own: those that are to be made here; none to ask for all.
        may_replace: whether others may be there.

    Raises:
        ConfigError: there are others, and they may not be.
    """
    known = {shard.name: shard for shard in shards}
    every = sorted(folder.glob("*.h5"))
    there = {
        file.name
        for file in every
        if file.name in known and is_there(file, recipe, known[file.name])
    }
    foreign = [file for file in every if file.name not in there]
    for file in foreign:
        expect(
            may_replace,
            f"`out` to be new or to hold shards of one recipe and version, got {file} "
            "of another. Choose another "
            "`out`, or pass --overwrite with the recipe, settings and version of the "
            "other shards.",
        )
    # Those of other shards are for these to replace; what is half-written of these is
    # of a killed run.
    mine = {shard.name for shard in own}
    half = [
        file
        for file in folder.glob(".*.partial")
        if any(f".{name}." in file.name for name in mine)
    ]
    for file in [
        file
        for file in foreign
        if own and (file.name in mine or file.name not in known)
    ] + half:
        file.unlink(missing_ok=True)
    return [shard for shard in own or shards if shard.name not in there]
