"""Traversability over slope, class by class: Gaussian processes and soft spots, and the
cells they learn from.
"""
