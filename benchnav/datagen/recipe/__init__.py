"""Recipes of datasets, with their scenarios and the class table."""
