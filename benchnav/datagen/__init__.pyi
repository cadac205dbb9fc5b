from benchnav.datagen.files.create import create as create_dataset
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.maps import TerrainMaps
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.layers.layer import DrawnMaps, Layer, Streams
from benchnav.datagen.recipe.classes import TerrainClass
from benchnav.datagen.recipe.load import load_recipe, recipe_from_dict, shipped_recipes
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.synth.generate import generate

__all__ = [
    "DrawnMaps",
    "Layer",
    "Recipe",
    "Streams",
    "TerrainClass",
    "TerrainDataset",
    "TerrainMaps",
    "create_dataset",
    "find_dataset",
    "generate",
    "load_recipe",
    "recipe_from_dict",
    "shipped_recipes",
]
