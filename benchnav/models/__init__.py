"""Traversability models: classifier, class-wise Gaussian processes, fusion (paper, III-B)."""
