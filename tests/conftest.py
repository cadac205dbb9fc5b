"""Fixtures shared by the tests."""

import atexit
import gc
from collections.abc import Iterable
from functools import cache
from importlib.metadata import version
from pathlib import Path

import pytest
import torch

from benchnav.core import part_lookup, sources
from benchnav.eval.folder import provenance
from benchnav.viz import style as figures
from tests import factories

# What collection imports stays. To search it for garbage takes seconds, while it is
# imported and in each test.
_THRESHOLD = gc.get_threshold()
gc.set_threshold(1_000_000)
torch.set_num_threads(1)
# To embed a font as publishers ask takes half a second a file.
_SAVED = figures._SAVE_STYLE.copy()
figures._SAVE_STYLE["pdf.fonttype"] = 3


@cache
def _digest_of_test_modules(names: tuple[str, ...]) -> str:
    return sources.digest_of_modules(names)


def _digest_of_modules(names: Iterable[str]) -> str:
    """Read the package `tests` once per process, since each digest reads all of it."""
    if all(name.startswith("tests.") for name in names):
        return _digest_of_test_modules(tuple(sorted(names)))
    return sources.digest_of_modules(names)


part_lookup.digest_of_modules = _digest_of_modules
# Each new run asks for the versions of installed packages, which do not change here.
provenance.version = cache(version)


def pytest_collection_finish() -> None:
    """Excludes what collection imported from garbage collection until the process ends."""
    gc.freeze()
    atexit.register(gc.unfreeze)
    gc.set_threshold(*_THRESHOLD)


@pytest.fixture
def whole_fonts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has figures saved as they are outside tests."""
    monkeypatch.setattr(figures, "_SAVE_STYLE", _SAVED)


@pytest.fixture(scope="session")
def dataset_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny dataset with all splits."""
    return factories.tiny_dataset(tmp_path_factory.mktemp("data") / "tiny.h5")
