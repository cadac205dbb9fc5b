"""BenchNav: benchmarks for off-road robot navigation under uncertain traversability.

Importing the package registers the Gymnasium environment `benchnav/OffRoad-v0`.
"""

import gymnasium

__version__ = "0.7.0"

gymnasium.register(
    id="benchnav/OffRoad-v0",
    entry_point="benchnav.env.environment:OffRoadEnv",
    vector_entry_point="benchnav.env.environment:OffRoadVectorEnv",
)
