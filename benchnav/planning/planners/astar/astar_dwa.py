"""A*+DWA: DWA drives to waypoints on a global path over the map's cells.

Source: paper IV-A1.
"""

from dataclasses import dataclass, field

from benchnav.planning.planners.astar.dwa import DWA, DWAConfig, DWAState
from benchnav.planning.planners.astar.guided import GuideConfig, Guided
from benchnav.planning.robots import SPEED, TURN_RATE


@dataclass(frozen=True, kw_only=True)
class AStarDWAConfig(GuideConfig):
    """Settings of A*+DWA, in addition to those of the global path.

    Args:
        dwa: settings of DWA.
    """

    dwa: DWAConfig = field(default_factory=DWAConfig)


class AStarDWA(Guided[DWAState]):
    """Planner in which A* provides waypoints to the dynamic window approach (DWA).

    Args:
        config: settings.
    """

    steers = ((SPEED, TURN_RATE),)

    def __init__(self, config: AStarDWAConfig | None = None) -> None:
        """Store the settings."""
        config = config or AStarDWAConfig()
        super().__init__(config, DWA(config.dwa))
