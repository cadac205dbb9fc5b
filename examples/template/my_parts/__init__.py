"""A planner and a model for BenchNav, which finds them by the entry points in
pyproject.toml.
"""
