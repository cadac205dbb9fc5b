from benchnav.core.errors import BenchnavError, CheckpointError, ConfigError, DatasetError
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.registry import register
from benchnav.core.terrain import Observation, Terrain

__all__ = [
    "BenchnavError",
    "CheckpointError",
    "ConfigError",
    "DatasetError",
    "Grid",
    "Observation",
    "Terrain",
    "TraversabilityMixture",
    "register",
]

__version__: str
