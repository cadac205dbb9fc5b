"""Generation of maps from a recipe, in NumPy."""
