"""BenchNav: benchmarks for off-road robot navigation under uncertain traversability.

Importing the package registers the Gymnasium environments `benchnav/OffRoad-v0` and
`benchnav/OffRoad-v1`, and does not import PyTorch.
"""

import gymnasium

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.core.batch": ("Batch",),
        "benchnav.core.conditioned": ("ConditionedDistribution",),
        "benchnav.core.distribution": ("TraversabilityDistribution",),
        "benchnav.core.errors": (
            "BenchnavError",
            "CheckpointError",
            "ConfigError",
            "DatasetError",
            "TrainingError",
        ),
        "benchnav.core.grid": ("Grid",),
        "benchnav.core.mixture": ("TraversabilityMixture",),
        "benchnav.core.pooled": ("pool",),
        "benchnav.core.quantiles": ("QuantileDistribution",),
        "benchnav.core.registry": ("register",),
        "benchnav.core.terrain": ("Observation", "Terrain"),
        "benchnav.eval.evaluation": ("evaluate",),
        "benchnav.eval.results": ("Results", "open_results as open_run"),
    },
)

__version__ = "2.1.0.dev0"

# The import of Gymnasium takes 0.05 s after that of NumPy, and does not import PyTorch.
gymnasium.register(
    id="benchnav/OffRoad-v0",
    entry_point="benchnav.env.environment:OffRoadEnv",
    vector_entry_point="benchnav.env.environment:OffRoadVectorEnv",
)
gymnasium.register(
    id="benchnav/OffRoad-v1",
    entry_point="benchnav.env.egocentric:EgocentricEnv",
    vector_entry_point="benchnav.env.egocentric:EgocentricVectorEnv",
)
