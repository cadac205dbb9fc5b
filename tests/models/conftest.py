"""One tiny dataset and one tiny trained checkpoint for all tests of the models."""

from pathlib import Path

import pytest

from benchnav.datagen.files.reader import TerrainDataset
from tests.models.support import make_dataset


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> TerrainDataset:
    path = tmp_path_factory.mktemp("data") / "tiny.h5"
    return make_dataset(path, train=10, valid=4, test_std=2, test_hs=2)


@pytest.fixture(scope="session")
def checkpoint_path(
    dataset: TerrainDataset, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A checkpoint with both halves, trained for a moment."""
    from benchnav.models.cli import TrainOptions, train_all
    from benchnav.models.config import ClassifierConfig, LatentGPConfig

    out = tmp_path_factory.mktemp("checkpoints") / "tiny"
    train_all(
        TrainOptions(device="cpu", trainer={"precision": "32-true"}),
        str(dataset.path),
        str(out),
        ClassifierConfig(max_epochs=1, batch_size=5),
        LatentGPConfig(epochs=2, epoch_steps=10),
    )
    return out
