from benchnav.core.errors import BenchnavError as BenchnavError
from benchnav.core.errors import CheckpointError as CheckpointError
from benchnav.core.errors import ConfigError as ConfigError
from benchnav.core.errors import DatasetError as DatasetError
from benchnav.core.grid import Grid as Grid
from benchnav.core.mixture import TraversabilityMixture as TraversabilityMixture
from benchnav.core.registry import register as register
from benchnav.core.terrain import Observation as Observation
from benchnav.core.terrain import Terrain as Terrain

__version__: str
