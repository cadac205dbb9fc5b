"""Path following: pure pursuit steers, a PID holds the speed.

Pure pursuit drives the arc that is tangent to the robot and meets the path one
look-ahead distance on. The PID compares the speed over ground with the wanted one, so
it makes up for ground that slows the robot, as far as the bounds allow; where an arc
asks for a turn rate out of bounds, the speed gives way and the arc is kept.
Traversability that scales both velocities alike thus bears on when the robot is
somewhere, hardly on where. The robot is driven by (v, ω), as a unicycle is. One whose
turn rate changes within a limit would weave about a path that it looks too short a way
ahead on: the look-ahead distance is at least what it drives while its turn rate builds
up.

Where the robot is along the path is itself a state, its progress: an arc length that
each step moves forward to the robot's projection on the path's tangent. It never goes
back, so paths may cross
themselves. Sources: Coulter (1992), "Implementation of the pure pursuit path tracking
algorithm"; paper IV-A2. Letters in shapes: N points, S state and A action dimensions.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.planning.planners.planner import check_finite
from benchnav.planning.robots import SPEED, TURN_RATE, Robot

SPACING_M = 0.1  # between the points of a reference
_LEAST_CURVATURE = 1e-6
_LEAST_SQUARE_M2 = 1e-6


@dataclass(frozen=True, kw_only=True)
class FollowerConfig:
    """Settings of a path follower.

    Args:
        lookahead_m: distance along the path from the robot to the point that it steers
            for, at least.
        lookahead_s: the same as what the robot drives in so many seconds at the wanted
            speed, where that is more.
        speed_mps: speed over ground that is wanted; without it the robot's top speed
            forward.
        speed_kp: proportional gain of the speed, on top of the wanted speed itself.
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
        """Refuses settings that lead nowhere."""
        least = "lookahead_s", "speed_kp", "speed_ki", "speed_kd"
        check_finite("a path follower", self, ("lookahead_m", "speed_mps"), least)


@dataclass(frozen=True)
class Reference:
    """Paths to follow, kept as rows of one table so that a lookup is one gather.

    Args:
        rows: points (x, y, cos θ, sin θ) of all paths, `SPACING_M` apart, shape [R, 4].
        first: row at which each path begins, int64, shape [*B].
        count: points N of a path.
    """

    rows: Tensor
    first: Tensor
    count: int

    @classmethod
    def along(cls, poses: Tensor, length_m: Tensor) -> "Reference":
        """Makes references that run straight on past the ends of their paths.

        Args:
            poses: (x, y, θ) each `SPACING_M` on, past the end the end pose, shape [*B,
                N, 3].
            length_m: length of each path, shape [*B].
        """
        *batch, count, _ = poses.shape
        arc = torch.arange(count, dtype=poses.dtype, device=poses.device) * SPACING_M
        beyond = (arc - length_m[..., None]).clamp(min=0)
        cos, sin = poses[..., 2].cos(), poses[..., 2].sin()
        rows = torch.stack(
            (poses[..., 0] + beyond * cos, poses[..., 1] + beyond * sin, cos, sin),
            dim=-1,
        )
        first = (
            torch.arange(math.prod(batch), device=poses.device).reshape(batch) * count
        )
        return cls(rows.reshape(-1, 4), first, count)

    def at(self, arc_m: Tensor) -> Tensor:
        """Looks up the last point at or before an arc length, which must lie on the
        path.

        Returns:
            (x, y, cos θ, sin θ), shape [*B, 4].
        """
        row = self.first + (arc_m * (1 / SPACING_M)).long()
        return self.rows.index_select(0, row.flatten()).reshape(*row.shape, 4)


@dataclass(frozen=True)
class Tracking(Batch):
    """What a follower carries from step to step, beside its progress.

    Args:
        position_m: where the robot was a step ago, shape [*B, 2].
        integral: the integral term of the speed, m/s, shape [*B].
        error_mps: the speed's error a step ago, shape [*B].
    """

    position_m: Tensor
    integral: Tensor
    error_mps: Tensor

    @classmethod
    def standing(cls, state: Tensor) -> "Tracking":
        """Tracking of robots that stand at the beginning of their references, states
        [*B, S].
        """
        zero = torch.zeros_like(state[..., 0])
        return cls(state[..., :2], zero, zero)


class PathFollower:
    """Follows references.

    Args:
        config: settings.
        robot: gives the time step and the bounds of (v, ω), and of their changes where
            it has some.

    Raises:
        ConfigError: the robot has other actions, cannot drive forward, or turns one way
            alone.
    """

    def __init__(self, config: FollowerConfig, robot: Robot) -> None:
        """Reads the bounds."""
        names, low, high = (
            tuple(robot.action_names),
            robot.action_low,
            robot.action_high,
        )
        expect(
            names == (SPEED, TURN_RATE) and high[0] > 0 and low[1] < 0 < high[1],
            f"a robot with actions ({SPEED}, {TURN_RATE}), the first up to more than "
            "0 and the second to both sides, "
            f"got ({', '.join(names)}) from {tuple(low)} to {tuple(high)}. Take a "
            "planner that samples actions, such "
            "as mppi.",
        )
        self.config = config
        self.dt_s = robot.dt_s
        self.speed_mps = low[0], high[0]
        self.wanted_mps = (
            high[0] if config.speed_mps is None else min(config.speed_mps, high[0])
        )
        self.turn_rate_radps = min(-low[1], high[1])
        self.tightest_m = low[0] / self.turn_rate_radps  # radius of the tightest turn
        rates = robot.action_rates
        build_up_s = self.turn_rate_radps / rates[1] if rates else 0.0
        self.lookahead_m = max(
            config.lookahead_m, max(config.lookahead_s, build_up_s) * self.wanted_mps
        )

    def advance(
        self, reference: Reference, state: Tensor, progress_m: Tensor
    ) -> Tensor:
        """Moves the progress forward to where the robot is now.

        Args:
            reference: paths, of shape [*B].
            state: shape [*B, S].
            progress_m: shape [*B].

        Returns:
            The new progress, no further than leaves the look-ahead point on the
            reference.
        """
        near_x, near_y, cos, sin = reference.at(progress_m).unbind(-1)
        at = (progress_m * (1 / SPACING_M)).floor() * SPACING_M
        projected = at + (state[..., 0] - near_x) * cos + (state[..., 1] - near_y) * sin
        last = (reference.count - 1) * SPACING_M - self.lookahead_m
        return torch.maximum(progress_m, projected).clamp(max=last)

    def act(
        self,
        reference: Reference,
        state: Tensor,
        tracking: Tracking,
        progress_m: Tensor,
    ) -> tuple[Tensor, Tracking]:
        """Chooses an action.

        Args:
            reference: paths, of shape [*B].
            state: shape [*B, S].
            tracking: from the step before.
            progress_m: from `advance`, shape [*B].

        Returns:
            Actions (v, ω) within the bounds, shape [*B, 2], and the next tracking.
        """
        config = self.config
        # Pure pursuit: the arc through the look-ahead point.
        x, y, heading = state[..., 0], state[..., 1], state[..., 2]
        aim = reference.at(progress_m + self.lookahead_m)
        aim_x, aim_y = aim[..., 0] - x, aim[..., 1] - y
        sideways = aim_y * heading.cos() - aim_x * heading.sin()
        curvature = 2 * sideways / (aim_x * aim_x + aim_y * aim_y + _LEAST_SQUARE_M2)

        # PID: the wanted speed, corrected by the error of the speed over ground.
        moved = state[..., :2] - tracking.position_m
        error = self.wanted_mps - torch.hypot(moved[..., 0], moved[..., 1]) * (
            1 / self.dt_s
        )
        low, high = self.speed_mps
        reach = high - low
        integral = (tracking.integral + error * (config.speed_ki * self.dt_s)).clamp(
            -reach, reach
        )
        speed = self.wanted_mps + config.speed_kp * error + integral
        if config.speed_kd:
            speed = speed + (error - tracking.error_mps) * (config.speed_kd / self.dt_s)
        speed = torch.minimum(
            speed, self.turn_rate_radps / curvature.abs().clamp(min=_LEAST_CURVATURE)
        )
        speed = speed.clamp(low, high)
        turn_rate = (speed * curvature).clamp(
            -self.turn_rate_radps, self.turn_rate_radps
        )
        action = torch.stack((speed, turn_rate), dim=-1)
        return action, Tracking(state[..., :2], integral, error)
