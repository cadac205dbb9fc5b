"""A* + MPPI: a global path over the map's cells, followed by model predictive path integral control.

Beyond the paper, which runs MPPI without a global path and combines global and local planners.
"""

from dataclasses import dataclass, field

from benchnav.planning.planners.astar.guided import GuideConfig, Guided
from benchnav.planning.planners.mppi import MPPI, MPPIConfig, MPPIState
from benchnav.planning.planners.straight import STEERS


@dataclass(frozen=True, kw_only=True)
class AStarMPPIConfig(GuideConfig):
    """Settings of A* + MPPI: those of the global path, and these.

    Args:
        mppi: settings of MPPI.
    """

    mppi: MPPIConfig = field(default_factory=MPPIConfig)


class AStarMPPI(Guided[MPPIState]):
    """A* gives way-points to model predictive path integral control.

    Args:
        config: settings.
    """

    steers = STEERS  # MPPI drives any robot, the recovery these.

    def __init__(self, config: AStarMPPIConfig | None = None) -> None:
        """Keeps the settings; all else is in the plan state."""
        config = config or AStarMPPIConfig()
        super().__init__(config, MPPI(config.mppi))
