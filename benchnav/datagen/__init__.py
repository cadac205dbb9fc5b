"""Terrain: recipes, synthesis, and datasets with their readers."""

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
        "benchnav.datagen.recipe.load": (
            "load_recipe",
            "recipe_from_dict",
            "shipped_recipes",
        ),
        "benchnav.datagen.recipe.recipe": ("Recipe",),
        "benchnav.datagen.synth.generate": ("generate",),
    },
)
