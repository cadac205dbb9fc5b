"""Making datasets: blocks of maps in parallel, kept until the file is whole.

Blocks are kept in the target's workspace; a killed run goes on from those it finished. They are made
by processes forked from this one where the system can: they start at once and end with it. (Threads
hand the interpreter's lock over too often to gain anything.)
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

import numpy as np

import benchnav
from benchnav.datagen.files.block import BLOCK_MAPS, Block, spans
from benchnav.datagen.files.writer import check_target, named_errors, workspace, writing_into
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.synth.generate import generate
from benchnav.errors import ConfigError
from benchnav.files import write_text

Span = tuple[str, int, int]  # split, first map, one past the last


def create(
    recipe: Recipe, path: Path, jobs: int = 1, block_maps: int = BLOCK_MAPS, overwrite: bool = False
) -> Iterator[tuple[int, int]]:
    """Makes a dataset, yielding (maps done, maps in all) as it goes; to be iterated to the end.

    What comes first is told before anything is made: the maps that a killed run has left, and those in all.

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
    check_target(path, overwrite=True)
    work = [(split, *span) for split, spec in recipe.splits.items() for span in spans(spec.maps, block_maps)]
    total = sum(stop - start for _, start, stop in work)
    splits = {
        name: {
            "scenario": spec.scenario,
            "maps": spec.maps,
            "parts": [{"maps": spec.maps, "recipe": 0, "split": name, "first": 0}],
        }
        for name, spec in recipe.splits.items()
    }
    with named_errors(path), _workers(jobs) as run, workspace(path, overwrite) as folder:
        _drop_other_blocks(folder, recipe, block_maps)
        make = partial(_make_block, recipe, folder)
        there = {span for span in work if _block_path(folder, span).exists()}
        done = sum(stop - start for _, start, stop in there)
        yield done, total
        with _left_nothing(folder), writing_into(folder, path, recipe.id, [recipe], splits) as write:
            for (split, start, stop), finished in zip(work, run(make, work), strict=True):
                write(split, Block.load(finished))
                done += 0 if (split, start, stop) in there else stop - start
                yield done, total
        shutil.rmtree(folder, ignore_errors=True)


def _make_block(recipe: Recipe, folder: Path, span: Span) -> Path:
    split, start, stop = span
    path = _block_path(folder, span)
    if not Block.is_whole(path):
        Block.of(generate(recipe, split, np.arange(start, stop))).save(path)
    return path


def _block_path(folder: Path, span: Span) -> Path:
    split, start, stop = span
    return folder / f"{split.replace('/', '+')}-{start:07d}-{stop:07d}.block"


@contextmanager
def _left_nothing(folder: Path) -> Iterator[None]:
    """Removes the finished blocks of a recipe that cannot be met: there is nothing to go on to."""
    try:
        yield
    except ConfigError:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _drop_other_blocks(folder: Path, recipe: Recipe, block_maps: int) -> None:
    """Removes finished blocks that are not of this recipe, cut and version."""
    made_of = {"recipe": recipe.to_dict(), "block_maps": block_maps, "version": benchnav.__version__}
    stamp, text = folder / "made_of.json", json.dumps(made_of, sort_keys=True)
    if not stamp.exists() or stamp.read_text() != text:
        for finished in folder.glob("*.block"):
            finished.unlink()
        write_text(stamp, text)


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
        # Fork now: a worker shall hold neither the lock nor the file that are opened next.
        executor.submit(int).result()
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
