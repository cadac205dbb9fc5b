"""Datasets on disk: reading, writing, making, checking and merging them."""
