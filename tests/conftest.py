"""Fixtures shared by the tests."""

from pathlib import Path

import pytest
import torch

from tests import factories

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def dataset_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny dataset with all splits."""
    return factories.tiny_dataset(tmp_path_factory.mktemp("data") / "tiny.h5")
