"""Creation, reading, checks, description and merging of datasets on disk."""
