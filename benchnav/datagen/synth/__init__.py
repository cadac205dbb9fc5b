"""From a recipe to maps, in NumPy."""
