"""Fixtures shared by the tests."""

from pathlib import Path

import pytest
import torch

from benchnav.core import figures
from tests import factories

torch.set_num_threads(1)
# To embed a font as publishers ask takes half a second a file.
_SAVED = figures._SAVED.copy()
figures._SAVED["pdf.fonttype"] = 3


@pytest.fixture
def whole_fonts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has figures saved as they are outside tests."""
    monkeypatch.setattr(figures, "_SAVED", _SAVED)


@pytest.fixture(scope="session")
def dataset_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny dataset with all splits."""
    return factories.tiny_dataset(tmp_path_factory.mktemp("data") / "tiny.h5")
