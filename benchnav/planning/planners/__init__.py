"""Planners: their common interface, and the shipped planners.

Entry points in `pyproject.toml` list the planners by name.
"""
