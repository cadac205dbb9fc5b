"""Traversability as a function of slope per class: Gaussian processes and soft spots."""
