"""Writing datasets of format 1.0 (HDF5).

A dataset is made in blocks of maps kept beside the target in `.NAME.partial`; a killed run goes on
from the blocks it finished. The target's name never holds a partial file.

Blocks are made by processes forked from this one where the system can: they start at once and end
with it. (Threads hand the interpreter's lock over too often to gain anything.)
"""

import gc
import json
import multiprocessing
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import benchnav
from benchnav.datagen import block, schema
from benchnav.datagen.block import Block
from benchnav.datagen.generate import generate
from benchnav.datagen.scenario import Recipe
from benchnav.errors import DatasetError
from benchnav.files import replacing, sole_writer, write_text

BLOCK_MAPS = 32

Span = tuple[str, int, int]  # split, first map, one past the last


def create(
    recipe: Recipe, path: Path, jobs: int = 1, block_maps: int = BLOCK_MAPS, overwrite: bool = False
) -> Iterator[tuple[int, int]]:
    """Makes a dataset, yielding (maps done, maps in all) as it goes; to be iterated to the end.

    Args:
        recipe: what to make.
        path: file to write.
        jobs: processes to make maps in.
        block_maps: maps a unit of work; changes nothing in the result.
        overwrite: replace a file that is there.

    Raises:
        DatasetError: the file exists, another run is writing it, or it cannot be written.
        ConfigError: the recipe cannot be met.
    """
    check_target(path, overwrite)
    spans = [
        (split, start, min(start + block_maps, spec.maps))
        for split, spec in recipe.splits.items()
        for start in range(0, spec.maps, block_maps)
    ]
    total = sum(stop - start for _, start, stop in spans)
    splits = {
        name: {
            "scenario": spec.scenario,
            "maps": spec.maps,
            "parts": [{"maps": spec.maps, "recipe": 0, "split": name, "first": 0}],
        }
        for name, spec in recipe.splits.items()
    }
    with named_errors(path), _workspace(path, _made_of(recipe, block_maps)) as folder:
        make = partial(_make_block, recipe, folder)
        with _workers(jobs) as run, writing(path, recipe.id, [recipe], splits) as write:
            done = 0
            for (split, start, stop), finished in zip(spans, run(make, spans), strict=True):
                write(split, Block.load(finished))
                done += stop - start
                yield done, total
        shutil.rmtree(folder, ignore_errors=True)


def check_target(path: Path, overwrite: bool) -> None:
    """Refuses a target that is there, unless it is to be replaced.

    Raises:
        DatasetError: `path` exists and `overwrite` is false.
    """
    if path.exists() and not overwrite:
        raise DatasetError(
            f"Expected `out` to be a new file, but {path} exists. Pass --overwrite true to replace it."
        )


@contextmanager
def writing(
    path: Path, dataset_id: str, recipes: list[Recipe], splits: dict[str, dict[str, Any]]
) -> Iterator[Callable[[str, Block], None]]:
    """Writes a dataset file whole or not at all.

    Args:
        path: file to write or replace.
        dataset_id: name and version of the dataset.
        recipes: what the splits' parts refer to by number. The first gives grid and class table.
        splits: by name, the manifest's entry of each split without its digest.

    Yields:
        A function to be given every block with the name of its split, each split's in the order of
        its maps.
    """
    height, width = recipes[0].grid.shape
    digests = {name: schema.SplitDigest(entry["maps"], height, width) for name, entry in splits.items()}
    written = dict.fromkeys(splits, 0)
    # Structures of HDF5 1.10 carry checksums of their own, so damage to them is found as well.
    with replacing(path) as unfinished, h5py.File(unfinished, "w", libver=("v110", "v110")) as file:
        groups = {
            name: block.new_split(file, name, entry["maps"], height, width) for name, entry in splits.items()
        }

        def write(split: str, made: Block) -> None:
            block.write(groups[split], written[split], made)
            digests[split].update(made.digests)
            written[split] += len(made)

        yield write
        assert written == {name: entry["maps"] for name, entry in splits.items()}
        manifest = {
            "format": schema.FORMAT,
            "format_version": ".".join(map(str, schema.FORMAT_VERSION)),
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


@contextmanager
def named_errors(path: Path) -> Iterator[None]:
    """Tells which file could not be written, and that nothing stands under its name."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise DatasetError(
            f"Could not write {path}: {reason}. Nothing new was left under its name; what was finished is "
            "kept beside it, and the same command goes on."
        ) from error


def _made_of(recipe: Recipe, block_maps: int) -> dict[str, Any]:
    return {"recipe": recipe.to_dict(), "block_maps": block_maps, "version": benchnav.__version__}


def _make_block(recipe: Recipe, folder: Path, span: Span) -> Path:
    split, start, stop = span
    path = folder / f"{split.replace('/', '+')}-{start:07d}-{stop:07d}.block"
    if not Block.is_whole(path):
        Block.of(generate(recipe, split, np.arange(start, stop))).save(path)
    return path


@contextmanager
def _workers(jobs: int) -> Iterator[Callable[[Callable[[Span], Path], list[Span]], Iterable[Path]]]:
    """Gives a `map` that runs in `jobs` processes; here when it is one."""
    if jobs == 1:
        _keep_freed_memory()
        yield map
        return
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    executor = ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker)
    try:
        yield executor.map
    finally:
        executor.shutdown(cancel_futures=True)


def _start_worker() -> None:
    # An interrupt is for the parent to act on; and a parent that is killed takes its workers along.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Collecting garbage would walk through, and so copy, all that was forked.
    gc.freeze()
    _keep_freed_memory()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _keep_freed_memory() -> None:
    """Keeps the C library from handing each freed array back to the kernel, to be zeroed and mapped anew.

    glibc raises its thresholds to the largest array that was ever freed. It saves a third of the time;
    other C libraries take no notice.
    """
    np.empty(4_000_000)


@contextmanager
def _workspace(path: Path, made_of: dict[str, Any]) -> Iterator[Path]:
    """Holds the folder of finished blocks, one run at a time; blocks of another recipe are dropped."""
    folder = path.parent / f".{path.name}.partial"
    folder.mkdir(exist_ok=True)
    with sole_writer(folder, str(path)):
        stamp, text = folder / "made_of.json", json.dumps(made_of, sort_keys=True)
        if not stamp.exists() or stamp.read_text() != text:
            for finished in folder.glob("*.block"):
                finished.unlink()
            write_text(stamp, text)
        yield folder
