"""Measurements of speed. Each module prints a table: `python -m benchmarks.engine`."""
