"""A*+MPPI: MPPI drives to waypoints on a global path over the map's cells.

The paper runs MPPI only without a global path.
"""

from dataclasses import dataclass, field

from benchnav.core.errors import expect
from benchnav.planning.planners.astar.guided import GuideConfig, Guided
from benchnav.planning.planners.mppi import MPPI, MPPIState
from benchnav.planning.planners.mppi_config import MPPIConfig
from benchnav.planning.planners.straight import STEERS


@dataclass(frozen=True, kw_only=True)
class AStarMPPIConfig(GuideConfig):
    """Settings of A*+MPPI, in addition to those of the global path.

    Args:
        mppi: settings of MPPI.
    """

    mppi: MPPIConfig = field(default_factory=MPPIConfig)

    def __post_init__(self) -> None:
        """Check that `explore` can affect the robot's path."""
        super().__post_init__()
        expect(
            self.explore == 0 or self.mppi.cost_to_go == "objective",
            f"`explore` = 0 for A*+MPPI with `cost_to_go` {self.mppi.cost_to_go!r}, "
            f"got {self.explore}. With this `cost_to_go`, MPPI does not drive to "
            "waypoints of A*. Set `explore` to 0, or `cost_to_go` to 'objective'.",
        )


class AStarMPPI(Guided[MPPIState]):
    """Planner in which A* provides waypoints to MPPI.

    If `cost_to_go` of MPPI is not `objective`, MPPI minimises costs to the goal, and
    A*'s path is used only in recovery.

    Args:
        config: settings.
    """

    steers = STEERS  # MPPI can steer any robot, but the recovery only these robots.

    def __init__(self, config: AStarMPPIConfig | None = None) -> None:
        """Store the settings."""
        config = config or AStarMPPIConfig()
        super().__init__(config, MPPI(config.mppi))
