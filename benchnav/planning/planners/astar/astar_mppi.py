"""A*+MPPI: a global path over the map's cells, followed by MPPI.

The paper runs MPPI without a global path. It also combines global and local planners,
but not A* and MPPI.
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
            "which minimises costs to the goal "
            f"and not to waypoints of A*, got {self.explore}.",
        )


class AStarMPPI(Guided[MPPIState]):
    """A* provides waypoints to model predictive path integral control.

    If `cost_to_go` is an option other than `objective`, MPPI minimises costs to the
    goal, and A*'s path is used only in recovery.

    Args:
        config: settings.
    """

    steers = STEERS  # MPPI steers any robot, but the recovery only these.

    def __init__(self, config: AStarMPPIConfig | None = None) -> None:
        """Store the settings."""
        config = config or AStarMPPIConfig()
        super().__init__(config, MPPI(config.mppi))
