"""Planner and model for BenchNav, which finds them by entry points in pyproject.toml."""
