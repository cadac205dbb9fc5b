"""The example of a user's own model, in a folder to work in."""

import shutil
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[3] / "examples" / "own_model.py"


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to work in, with the example in it."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(EXAMPLE, "own.py")
    return tmp_path
