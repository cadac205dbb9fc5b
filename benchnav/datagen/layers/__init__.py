"""Layers of recipes: maps that are drawn, change colours and change λ; one file a
shipped layer.
"""
