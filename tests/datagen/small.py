"""A small recipe of synthesis 2, with soft spots and classes that look alike."""

from dataclasses import replace
from typing import Any

from benchnav.datagen.layers.vegetation import Growth, Vegetation
from benchnav.datagen.recipe.classes import SoftSpots, TerrainClass
from benchnav.datagen.recipe.load import load_recipe
from benchnav.datagen.recipe.places import PlacesRule
from benchnav.datagen.recipe.recipe import Recipe, Split

SOFT = SoftSpots(weight=0.1, mean=0.05, std=0.05)


def small_stakes(**changes: Any) -> Recipe:
    """Maps of 16 m × 16 m with the classes of stakes-v1."""
    settings: dict[str, Any] = {
        "id": "small",
        "height": 32,
        "width": 32,
        "class_periods_m": (6, 3),
        "places": PlacesRule(least_distance_m=8, margin_m=1),
        "splits": {
            "train": Split(scenario="std", maps=8),
            "test/hg": Split(scenario="hg", maps=3, solvable=True),
        },
    }
    return replace(load_recipe("stakes-v1"), **settings | changes)


def grown(recipe: Recipe, period_m: float = 4.0, **classes: Growth) -> Recipe:
    """A recipe with vegetation on some classes."""
    return replace(recipe, layers=(Vegetation(period_m=period_m, classes=classes),))


def terrain_class(name: str, red: int = 100, **changes: Any) -> TerrainClass:
    """A class of any colour; by its red."""
    numbers = {"scale": 3.0, "exponent": 1.6, "offset": 0.05, "noise": 0.1} | changes
    return TerrainClass(name=name, colour=(red, 90, 80), **numbers)
