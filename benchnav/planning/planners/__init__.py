"""Planners: their common protocol, and the shipped planners.

Entry points in `pyproject.toml` name the planners.
"""
