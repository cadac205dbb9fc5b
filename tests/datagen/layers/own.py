"""The layer of a user's that the documentation shows, and recipes with it."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy import ndarray

from benchnav.core import registry
from benchnav.datagen.layers.layer import DrawnMaps, Layer, Streams
from benchnav.datagen.recipe.load import recipe_from_dict
from benchnav.datagen.recipe.recipe import Recipe
from tests.datagen.small import small_stakes
from tests.docs.pages import DOCS, blocks

PAGE = {
    block.file: block.body
    for block in blocks(DOCS / "how-to" / "own-layer.md")
    if block.file
}


def write_page(folder: Path) -> Path:
    """Write the layer and the recipe of the page, with fewer maps; return the recipe's
    path.
    """
    (folder / "wet.py").write_text(PAGE["wet.py"])
    recipe = yaml.safe_load(PAGE["wet.yaml"])
    recipe["splits"] = {
        "train": {"scenario": "std", "maps": 6},
        "valid": {"scenario": "std", "maps": 2},
        "test/std": {"scenario": "std", "maps": 3, "solvable": True},
    }
    path = folder / "wet.yaml"
    path.write_text(yaml.safe_dump(recipe))
    return path


def wet(folder: Path, **options: Any) -> Recipe:
    """The recipe `small_stakes` with the layer of the page."""
    (folder / "wet.py").write_text(PAGE["wet.py"])
    layer = {"part": f"{folder}/wet.py:Wetness", "options": options}
    return recipe_from_dict(small_stakes().to_dict() | {"layers": [layer]}, "test")


def wetness(folder: Path) -> type[Layer]:
    """The class of the page."""
    (folder / "wet.py").write_text(PAGE["wet.py"])
    return registry.find("layer", f"{folder}/wet.py:Wetness").target


class Plain(Layer):
    """A layer that shows nothing and leaves λ as it is, but that says that it changes
    both.
    """

    name = "plain"

    def draw(self, streams: Streams, maps: DrawnMaps) -> ndarray:
        return streams.normal("values")

    def look(self, rgb: ndarray, values: ndarray, maps: DrawnMaps) -> ndarray:
        return rgb + 0 * values[:, None]

    def affect(
        self, mean: ndarray, std: ndarray, values: ndarray, maps: DrawnMaps
    ) -> tuple[ndarray, ndarray]:
        return mean + 0 * values, std

    def class_weights(
        self, weights: ndarray, values: ndarray, maps: DrawnMaps
    ) -> ndarray:
        return np.copy(weights)
