"""A* + MPPI: a global path over the map's cells, followed by model predictive path
integral control.

Beyond the paper, which runs MPPI without a global path and combines global and local
planners.
"""

from dataclasses import dataclass, field

from benchnav.core.errors import expect
from benchnav.planning.planners.astar.guided import GuideConfig, Guided
from benchnav.planning.planners.mppi import MPPI, MPPIState
from benchnav.planning.planners.mppi_config import MPPIConfig
from benchnav.planning.planners.straight import STEERS


@dataclass(frozen=True, kw_only=True)
class AStarMPPIConfig(GuideConfig):
    """Settings of A* + MPPI: those of the global path, and these.

    Args:
        mppi: settings of MPPI.
    """

    mppi: MPPIConfig = field(default_factory=MPPIConfig)

    def __post_init__(self) -> None:
        """Check that `explore` has a path to move."""
        super().__post_init__()
        expect(
            self.explore == 0 or self.mppi.cost_to_go == "objective",
            f"`explore` = 0 for A*+MPPI with `cost_to_go` {self.mppi.cost_to_go!r}, "
            "whose costs run to the goal "
            f"and not to waypoints of A*, got {self.explore}.",
        )


class AStarMPPI(Guided[MPPIState]):
    """A* provides waypoints to model predictive path integral control.

    With a cost to go, which is A*'s, MPPI minimises a cost that runs to the goal; A*'s
    path then serves recovery.

    Args:
        config: settings.
    """

    steers = STEERS  # MPPI drives any robot, the recovery these.

    def __init__(self, config: AStarMPPIConfig | None = None) -> None:
        """Store the settings."""
        config = config or AStarMPPIConfig()
        super().__init__(config, MPPI(config.mppi))
