"""Settings of CL-RRT."""

from dataclasses import dataclass, field

from benchnav.core.errors import expect
from benchnav.planning.planners.cl_rrt.pursuit import FollowerConfig
from benchnav.planning.planners.planner import check_finite


@dataclass(frozen=True, kw_only=True)
class CLRRTConfig:
    """Settings of CL-RRT; the paper has no values, so the defaults are this project's.

    Args:
        expansions: number of edges that a plan simulates, a multiple of
            `expansions_per_round`.
        expansions_per_round: number of edges that are simulated at once.
        step_m: maximum length of an edge along its reference in metres.
        edge_time_s: maximum duration of an edge in seconds.
        goal_bias: fraction of the edges that lead toward the goal, in [0, 1].
        turning_radius_m: turning radius of the references in metres, halved after each
            plan without a path to the goal.
        replan_distance_m: distance from the nearest predicted position in metres beyond
            which a robot plans again.
        stall_s: time without progress in seconds after which a robot plans again.
        most_failures: maximum number of consecutive plans without a path to the goal.
            After them, the robot drives a partial path to its end. If there is no
            partial path either, edges may cross non-free cells.
        follower: settings of the controller, for simulation and for execution.
    """

    expansions: int = 500
    expansions_per_round: int = 25
    step_m: float = 5.0
    edge_time_s: float = 10.0
    goal_bias: float = 0.25
    turning_radius_m: float = 1.0
    replan_distance_m: float = 1.0
    stall_s: float = 5.0
    most_failures: int = 5
    follower: FollowerConfig = field(default_factory=FollowerConfig)

    def __post_init__(self) -> None:
        """Validate the settings."""
        above_zero = (
            "expansions",
            "expansions_per_round",
            "step_m",
            "edge_time_s",
            "turning_radius_m",
            "replan_distance_m",
            "stall_s",
            "most_failures",
        )
        check_finite("CL-RRT", self, above_zero)
        expect(
            self.expansions % self.expansions_per_round == 0,
            "`expansions` to be a multiple of `expansions_per_round` = "
            f"{self.expansions_per_round} for CL-RRT, got {self.expansions}.",
        )
        expect(
            0 <= self.goal_bias <= 1,
            f"`goal_bias` in [0, 1] for CL-RRT, got {self.goal_bias}.",
        )

    @property
    def rounds(self) -> int:
        """Number of rounds of a plan, and maximum number of edges of a path, D."""
        return self.expansions // self.expansions_per_round
