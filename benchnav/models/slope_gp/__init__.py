"""Traversability as a function of slope per class: Gaussian processes, soft spots and
their training cells.
"""
