"""Layers of recipes: drawn maps that may change colours and λ; a file per layer."""
