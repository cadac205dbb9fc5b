"""Synthetic 2.5D terrain: generation, storage and reading of datasets (paper, III-A)."""
