"""Path following: pure pursuit steers, and a PID controls the speed.

Pure pursuit drives the arc that is tangent to the robot's heading and meets the path
one look-ahead distance ahead. The PID compares the achieved speed with the target
speed. Hence it compensates for terrain that slows the robot, within the bounds of the
speed. If an arc needs a turn rate out of bounds, the speed is reduced and the arc is
kept. Hence traversability, which scales both velocities by the same factor, affects the
time at which a robot reaches a point of the path, but hardly its route.

The actions of the robot are (v, ω), as for a unicycle. If its angular acceleration
is limited, a short look-ahead would make it oscillate about the path. Hence the
look-ahead distance is at least the distance that it drives while its turn rate builds
up.

The robot's progress is an arc length along the path. Each step advances it to the
robot's projection on the path's tangent. It never decreases, so a path may cross
itself. Sources: Coulter (1992), "Implementation of the pure pursuit path tracking
algorithm"; paper IV-A2. Letters in shapes: *B any leading dimensions, N points of a
path, R rows of all paths, S state dimensions.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.planning.planners.planner import check_finite
from benchnav.planning.robots import SPEED, TURN_RATE, Robot

SPACING_M = 0.1  # distance between the points of a reference, in metres
_MIN_CURVATURE = 1e-6
_MIN_SQUARE_M2 = 1e-6


@dataclass(frozen=True, kw_only=True)
class FollowerConfig:
    """Settings of a path follower.

    Args:
        lookahead_m: minimum look-ahead distance along the path in metres.
        lookahead_s: minimum time in seconds to drive the look-ahead distance at the
            target speed.
        speed_mps: target speed in m/s; if None, the robot's top speed forward.
        speed_kp: proportional gain of the PID, whose output is added to the target
            speed.
        speed_ki: integral gain in 1/s.
        speed_kd: derivative gain in s.
    """

    lookahead_m: float = 0.6
    lookahead_s: float = 0.6
    speed_mps: float | None = None
    speed_kp: float = 0.5
    speed_ki: float = 0.5
    speed_kd: float = 0.0

    def __post_init__(self) -> None:
        """Validate the settings."""
        above_zero = "lookahead_m", "speed_mps"
        at_least_zero = "lookahead_s", "speed_kp", "speed_ki", "speed_kd"
        check_finite("a path follower", self, above_zero, at_least_zero)


@dataclass(frozen=True)
class Reference:
    """Paths to follow, all stored in one table.

    Args:
        rows: points (x, y, cos θ, sin θ) of all paths, `SPACING_M` apart, shape [R, 4].
        first: first row of each path, int64, shape [*B].
        count: number of points N of a path.
    """

    rows: Tensor
    first: Tensor
    count: int

    @classmethod
    def along(cls, poses: Tensor, length_m: Tensor) -> "Reference":
        """Return references that continue straight past the ends of their paths.

        Args:
            poses: poses (x, y, θ), `SPACING_M` apart, that repeat the end pose past the
                end, shape [*B, N, 3].
            length_m: length of each path in metres, shape [*B].
        """
        *batch, count, _ = poses.shape
        arc = torch.arange(count, dtype=poses.dtype, device=poses.device) * SPACING_M
        beyond = (arc - length_m[..., None]).clamp(min=0)
        cos = poses[..., 2].cos()
        sin = poses[..., 2].sin()
        x = poses[..., 0] + beyond * cos
        y = poses[..., 1] + beyond * sin
        rows = torch.stack((x, y, cos, sin), dim=-1)
        path = torch.arange(math.prod(batch), device=poses.device)
        first = path.reshape(batch) * count
        return cls(rows.reshape(-1, 4), first, count)

    def at(self, arc_m: Tensor) -> Tensor:
        """Return the last point at or before an arc length, which must be on the path.

        Args:
            arc_m: arc lengths in metres, shape [*B].

        Returns:
            Points (x, y, cos θ, sin θ), shape [*B, 4].
        """
        row = self.first + (arc_m * (1 / SPACING_M)).long()
        points = self.rows.index_select(0, row.flatten())
        return points.reshape(*row.shape, 4)


@dataclass(frozen=True)
class Tracking(Batch):
    """State of the controller, except the progress.

    Args:
        position_m: position (x, y) of the robot one step ago in metres, shape [*B, 2].
        integral: integral term of the speed in m/s, shape [*B].
        error_mps: error of the speed one step ago in m/s, shape [*B].
    """

    position_m: Tensor
    integral: Tensor
    error_mps: Tensor

    @classmethod
    def standing(cls, state: Tensor) -> "Tracking":
        """Return the tracking of standing robots, from states [*B, S]."""
        zero = torch.zeros_like(state[..., 0])
        return cls(state[..., :2], zero, zero)


class PathFollower:
    """Follower of references.

    Args:
        config: settings.
        robot: robot with the time step, the bounds of (v, ω) and any limits of their
            rates of change.

    Raises:
        ConfigError: If the robot has other actions, cannot drive forward, or turns only
            to one side.
    """

    def __init__(self, config: FollowerConfig, robot: Robot) -> None:
        """Store the robot's bounds."""
        names = tuple(robot.action_names)
        low = robot.action_low
        high = robot.action_high
        has_actions = names == (SPEED, TURN_RATE)
        expect(
            has_actions and high[0] > 0 and low[1] < 0 < high[1],
            f"a robot with actions ({SPEED}, {TURN_RATE}) that drives forward and turns "
            f"to both sides, got ({', '.join(names)}) from {tuple(low)} to "
            f"{tuple(high)}. "
            "Use a planner that samples actions, such as mppi.",
        )
        self.config = config
        self.dt_s = robot.dt_s
        self.speed_mps = low[0], high[0]
        self.wanted_mps = high[0]
        if config.speed_mps is not None:
            self.wanted_mps = min(config.speed_mps, high[0])
        self.turn_rate_radps = min(-low[1], high[1])
        self.tightest_m = low[0] / self.turn_rate_radps  # radius of the tightest turn
        rates = robot.action_rates
        build_up_s = self.turn_rate_radps / rates[1] if rates else 0.0
        lookahead_s = max(config.lookahead_s, build_up_s)
        self.lookahead_m = max(config.lookahead_m, lookahead_s * self.wanted_mps)

    def advance(
        self, reference: Reference, state: Tensor, progress_m: Tensor
    ) -> Tensor:
        """Return the progress after the robot's motion.

        Args:
            reference: paths, shape [*B].
            state: states of the robots, shape [*B, S].
            progress_m: progress before the motion in metres, shape [*B].

        Returns:
            The new progress in metres, shape [*B], limited so that the look-ahead point
            stays on the reference.
        """
        near_x, near_y, cos, sin = reference.at(progress_m).unbind(-1)
        near_m = (progress_m * (1 / SPACING_M)).floor() * SPACING_M
        dx = state[..., 0] - near_x
        dy = state[..., 1] - near_y
        projected_m = near_m + dx * cos + dy * sin
        last_m = (reference.count - 1) * SPACING_M - self.lookahead_m
        return torch.maximum(progress_m, projected_m).clamp(max=last_m)

    def act(
        self,
        reference: Reference,
        state: Tensor,
        tracking: Tracking,
        progress_m: Tensor,
    ) -> tuple[Tensor, Tracking]:
        """Return the next actions and the next state of the controller.

        Args:
            reference: paths, shape [*B].
            state: states of the robots, shape [*B, S].
            tracking: tracking from the last step.
            progress_m: progress from `advance` in metres, shape [*B].

        Returns:
            Actions (v, ω) within the bounds, shape [*B, 2], and the next tracking.
        """
        config = self.config
        # Pure pursuit: the arc through the look-ahead point.
        aim = reference.at(progress_m + self.lookahead_m)
        aim_x = aim[..., 0] - state[..., 0]
        aim_y = aim[..., 1] - state[..., 1]
        heading = state[..., 2]
        sideways = aim_y * heading.cos() - aim_x * heading.sin()
        square = aim_x * aim_x + aim_y * aim_y + _MIN_SQUARE_M2
        curvature = 2 * sideways / square

        # PID: the target speed, corrected by the error of the achieved speed.
        motion = state[..., :2] - tracking.position_m
        step_m = torch.hypot(motion[..., 0], motion[..., 1])
        error = self.wanted_mps - step_m * (1 / self.dt_s)
        low, high = self.speed_mps
        span = high - low
        integral = tracking.integral + error * (config.speed_ki * self.dt_s)
        integral = integral.clamp(-span, span)
        speed = self.wanted_mps + config.speed_kp * error + integral
        if config.speed_kd:
            change = error - tracking.error_mps
            speed = speed + change * (config.speed_kd / self.dt_s)
        max_turn_rate = self.turn_rate_radps
        bend = curvature.abs().clamp(min=_MIN_CURVATURE)
        speed = torch.minimum(speed, max_turn_rate / bend)
        speed = speed.clamp(low, high)
        turn_rate = speed * curvature
        turn_rate = turn_rate.clamp(-max_turn_rate, max_turn_rate)
        action = torch.stack((speed, turn_rate), dim=-1)
        return action, Tracking(state[..., :2], integral, error)
