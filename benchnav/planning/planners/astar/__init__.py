"""Planners with a path over the grid: A*, and planners that follow its waypoints."""
