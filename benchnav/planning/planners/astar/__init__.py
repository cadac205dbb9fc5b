"""Planners led by a path over the grid: A*, and what follows its way-points."""
