from benchnav.core.batch import Batch
from benchnav.core.conditioned import ConditionedDistribution
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import (
    BenchnavError,
    CheckpointError,
    ConfigError,
    DatasetError,
    TrainingError,
)
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.pooled import pool
from benchnav.core.quantiles import QuantileDistribution
from benchnav.core.registry import register
from benchnav.core.terrain import Observation, Terrain
from benchnav.eval.evaluation import evaluate
from benchnav.eval.results import Results
from benchnav.eval.results import open_results as open_run

__all__ = [
    "Batch",
    "BenchnavError",
    "CheckpointError",
    "ConditionedDistribution",
    "ConfigError",
    "DatasetError",
    "Grid",
    "Observation",
    "QuantileDistribution",
    "Results",
    "Terrain",
    "TrainingError",
    "TraversabilityDistribution",
    "TraversabilityMixture",
    "evaluate",
    "open_run",
    "pool",
    "register",
]

__version__: str
