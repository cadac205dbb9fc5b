from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.quality.baseline import nearest_colour, nearest_colour_accuracy
from tests.factories import tiny_dataset, tiny_recipe


def test_the_nearest_colour_is_found_for_each_cell() -> None:
    colours = torch.tensor([[0, 0, 0], [100, 100, 100], [200, 100, 0]])
    rgb = torch.tensor([[40, 40, 40], [60, 60, 60], [190, 90, 20]], dtype=torch.uint8).T.view(1, 3, 1, 3)
    assert nearest_colour(rgb, colours).tolist() == [[[0, 1, 2]]]


def test_in_full_light_colour_tells_every_class_and_in_shade_it_does_not(tmp_path: Path) -> None:
    recipe = tiny_recipe()
    bright = {name: replace(one, ambient=1.0) for name, one in recipe.scenarios.items()}
    lit = TerrainDataset(tiny_dataset(tmp_path / "lit.h5", replace(recipe, scenarios=bright)))
    assert nearest_colour_accuracy(lit, "train") == pytest.approx(1)
    shaded = TerrainDataset(tiny_dataset(tmp_path / "shaded.h5", recipe))
    accuracy = {split: nearest_colour_accuracy(shaded, split) for split in ("train", "test/hs")}
    assert 0 < accuracy["test/hs"] < accuracy["train"] < 1


def test_cells_without_a_class_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = tiny_recipe()
    bright = {name: replace(one, ambient=1.0) for name, one in recipe.scenarios.items()}
    lit = TerrainDataset(tiny_dataset(tmp_path / "lit.h5", replace(recipe, scenarios=bright)))
    read = lit.chunks

    def holed(*given: object) -> Iterator[tuple[object, dict[str, np.ndarray]]]:
        for indices, maps in read(*given):
            maps["class_id"][:, :11] = UNLABELLED
            yield indices, maps

    monkeypatch.setattr(lit, "chunks", holed)
    assert nearest_colour_accuracy(lit, "train") == pytest.approx(1)
