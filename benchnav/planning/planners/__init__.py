"""Planners: the protocol they share, and the shipped ones; `pyproject.toml` gives each
its name.
"""
