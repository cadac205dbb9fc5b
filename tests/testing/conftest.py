"""The tiny dataset and checkpoint of the models' tests."""

from tests.models.conftest import checkpoint_path, dataset

__all__ = ["checkpoint_path", "dataset"]
