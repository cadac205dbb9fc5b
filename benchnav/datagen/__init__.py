"""Terrain: recipes, synthesis, datasets and how they are read."""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.datagen.files.create": ("create as create_dataset",),
        "benchnav.datagen.files.find": ("find_dataset",),
        "benchnav.datagen.files.maps": ("TerrainMaps",),
        "benchnav.datagen.files.reader": ("TerrainDataset",),
        "benchnav.datagen.layers.layer": ("DrawnMaps", "Layer", "Streams"),
        "benchnav.datagen.recipe.classes": ("TerrainClass",),
        "benchnav.datagen.recipe.recipe": (
            "Recipe",
            "load_recipe",
            "recipe_from_dict",
            "shipped_recipes",
        ),
        "benchnav.datagen.synth.generate": ("generate",),
    },
)
