"""BenchNav: benchmarks for off-road robot navigation under uncertain traversability."""

__version__ = "0.1.0"
