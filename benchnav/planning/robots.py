"""Robots: state transitions F under actions and traversability.

A robot is a `Robot`. It is called as

    F(state [*B, S], action [*B, A], traversability [*B]) -> state [*B, S]

A state begins with (x, y, θ) in metres and radians. Planners call F with predicted
traversability, and the simulation calls it with true traversability. Sources: paper II
and IV-A; Rajamani (2012), "Vehicle dynamics and control", section 2.2 (bicycle).
Letters in shapes: *B any leading dimensions, S state and A action dimensions.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.errors import expect
from benchnav.core.specified import Specified
from benchnav.planning.footprint import Footprint

# Names of actions, by which planners recognise the actions that they can command.
SPEED = "speed_mps"
TURN_RATE = "turn_rate_radps"
STEERING = "steering_rad"


class Robot(Specified, ABC):
    """Base class of robots; `benchnav.testing.check_robot` checks the contract.

    Properties may also be class attributes, or fields of a dataclass with defaults.
    """

    @property
    @abstractmethod
    def dt_s(self) -> float:
        """Time step in seconds."""

    @property
    @abstractmethod
    def action_names(self) -> tuple[str, ...]:
        """Names of the A actions, with units, by which planners recognise them."""

    @property
    @abstractmethod
    def action_low(self) -> tuple[float, ...]:
        """Minimum of each action."""

    @property
    @abstractmethod
    def action_high(self) -> tuple[float, ...]:
        """Maximum of each action."""

    @property
    @abstractmethod
    def top_speed_mps(self) -> float:
        """Maximum speed on terrain of λ = 1, in m/s."""

    @property
    def action_rates(self) -> tuple[float, ...] | None:
        """Maximum change of each action per second; None if unlimited."""
        return None

    @property
    def footprint(self) -> Footprint | None:
        """Contacts with the terrain; None for a point."""
        return None

    @abstractmethod
    def initial_state(self, pose: Tensor) -> Tensor:
        """Return states [B, S] of robots that stand at poses (x, y, θ), [B, 3]."""

    @abstractmethod
    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Return the state after one time step.

        Args:
            state: states that begin with (x, y, θ), shape [*B, S].
            action: actions, shape [*B, A].
            traversability: λ at the robots' positions, in [0, 1], shape [*B].

        Returns:
            The next state, shape [*B, S]; no argument is modified.
        """


@dataclass(frozen=True, kw_only=True)
class _Vehicle(Robot):
    """Base class of the shipped robots, with a time step and bounds of the speed."""

    dt_s: float = 0.1
    speed_mps: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        """Validate the time step and the speed."""
        expect(self.dt_s > 0, f"`dt_s` > 0, got {self.dt_s}.")
        _check_bounds("speed_mps", self.speed_mps)

    @property
    def top_speed_mps(self) -> float:
        """Maximum |v| in m/s."""
        return max(map(abs, self.speed_mps))

    def initial_state(self, pose: Tensor) -> Tensor:
        """Return the poses as states; see `Robot`."""
        return pose.clone()


@dataclass(frozen=True, kw_only=True)
class Unicycle(_Vehicle):
    """The paper's unicycle: traversability scales linear and angular velocity.

    State (x, y, θ), action (v, ω). Source: paper IV-A.

    Args:
        dt_s: time step in seconds.
        speed_mps: minimum and maximum linear velocity v in m/s.
        turn_rate_radps: minimum and maximum angular velocity ω in rad/s.
    """

    action_names = SPEED, TURN_RATE
    turn_rate_radps: tuple[float, float] = (-1.0, 1.0)

    def __post_init__(self) -> None:
        """Validate the time step and the bounds."""
        super().__post_init__()
        _check_bounds("turn_rate_radps", self.turn_rate_radps)

    @property
    def action_low(self) -> tuple[float, ...]:
        """Minimum (v, ω)."""
        return self.speed_mps[0], self.turn_rate_radps[0]

    @property
    def action_high(self) -> tuple[float, ...]:
        """Maximum (v, ω)."""
        return self.speed_mps[1], self.turn_rate_radps[1]

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Return the state after one time step; see `Robot`."""
        scale = traversability * self.dt_s
        return _stack(_drive(state, action[..., 0], action[..., 1], scale))


@dataclass(frozen=True, kw_only=True)
class SkidSteer(Unicycle):
    """A unicycle on four wheels, two on each side, whose sides can slip apart.

    Planners assume the motion of a unicycle, and leave room for the contacts.

    Args:
        dt_s: time step in seconds.
        speed_mps: minimum and maximum linear velocity v in m/s.
        turn_rate_radps: minimum and maximum angular velocity ω in rad/s.
        track_m: distance between the left and the right wheels in metres.
        wheelbase_m: distance between the front and the rear wheels in metres.
    """

    track_m: float = 0.5
    wheelbase_m: float = 0.5

    @property
    def footprint(self) -> Footprint:
        """The four wheels, around the middle of the robot."""
        return Footprint(track_m=self.track_m, wheelbase_m=self.wheelbase_m)


@dataclass(frozen=True, kw_only=True)
class DifferentialDrive(Unicycle):
    """A differential drive: a unicycle with limited accelerations.

    State (x, y, θ, v, ω), commanded action (v, ω). The velocities in the state are
    those that the wheels would produce at λ = 1. Traversability scales the resulting
    motion.

    Args:
        dt_s: time step in seconds.
        speed_mps: minimum and maximum linear velocity v in m/s.
        turn_rate_radps: minimum and maximum angular velocity ω in rad/s.
        acceleration_mps2: maximum change of v in m/s².
        turn_acceleration_radps2: maximum change of ω in rad/s².
    """

    acceleration_mps2: float = 0.5
    turn_acceleration_radps2: float = 1.0

    def __post_init__(self) -> None:
        """Validate the bounds and the accelerations."""
        super().__post_init__()
        expect(
            self.acceleration_mps2 > 0 and self.turn_acceleration_radps2 > 0,
            "`acceleration_mps2` and `turn_acceleration_radps2` > 0, "
            f"got {self.acceleration_mps2} and {self.turn_acceleration_radps2}.",
        )

    @property
    def action_rates(self) -> tuple[float, ...]:
        """Maximum change of (v, ω) per second."""
        return self.acceleration_mps2, self.turn_acceleration_radps2

    def initial_state(self, pose: Tensor) -> Tensor:
        """Return a standing state at the pose; see `Robot`."""
        no_velocity = torch.zeros_like(pose[..., :2])
        return torch.cat((pose, no_velocity), dim=-1)

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Return the state after one time step; see `Robot`."""
        limit = self.acceleration_mps2 * self.dt_s
        turn_limit = self.turn_acceleration_radps2 * self.dt_s
        change = action[..., 0] - state[..., 3]
        turn_change = action[..., 1] - state[..., 4]
        speed = state[..., 3] + change.clamp(-limit, limit)
        turn_rate = state[..., 4] + turn_change.clamp(-turn_limit, turn_limit)
        pose = _drive(state, speed, turn_rate, traversability * self.dt_s)
        return _stack((*pose, speed, turn_rate))


@dataclass(frozen=True, kw_only=True)
class Bicycle(_Vehicle):
    """A kinematic bicycle, which turns only while it drives.

    State (x, y, θ) of the rear axle, action (v, δ) with the turn rate
    θ' = v tan(δ) / wheelbase. Traversability scales v, and hence also the turn rate.
    Source: Rajamani (2012).

    Args:
        dt_s: time step in seconds.
        speed_mps: minimum and maximum velocity v of the rear axle in m/s.
        steering_rad: maximum steering angle δ to both sides in radians.
        wheelbase_m: distance between the axles in metres.
    """

    action_names = SPEED, STEERING
    steering_rad: float = 0.6
    wheelbase_m: float = 0.5

    def __post_init__(self) -> None:
        """Validate the bounds and the wheelbase."""
        super().__post_init__()
        expect(
            0 < self.steering_rad < math.pi / 2 and self.wheelbase_m > 0,
            "`steering_rad` in (0, π/2) and `wheelbase_m` > 0, "
            f"got {self.steering_rad} and {self.wheelbase_m}.",
        )

    @property
    def action_low(self) -> tuple[float, ...]:
        """Minimum (v, δ)."""
        return self.speed_mps[0], -self.steering_rad

    @property
    def action_high(self) -> tuple[float, ...]:
        """Maximum (v, δ)."""
        return self.speed_mps[1], self.steering_rad

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Return the state after one time step; see `Robot`."""
        speed = action[..., 0]
        turn_rate = speed * action[..., 1].tan() / self.wheelbase_m
        scale = traversability * self.dt_s
        return _stack(_drive(state, speed, turn_rate, scale))


@dataclass(frozen=True, kw_only=True)
class Ackermann(Bicycle):
    """A kinematic bicycle on four wheels, whose sides can slip apart.

    Args:
        dt_s: time step in seconds.
        speed_mps: minimum and maximum velocity v of the rear axle in m/s.
        steering_rad: maximum steering angle δ to both sides in radians.
        wheelbase_m: distance between the axles in metres.
        track_m: distance between the left and the right wheels in metres.
    """

    track_m: float = 0.4

    @property
    def footprint(self) -> Footprint:
        """The four wheels; the robot's position is the middle of the rear axle."""
        ahead_m = self.wheelbase_m / 2
        return Footprint(
            track_m=self.track_m, wheelbase_m=self.wheelbase_m, ahead_m=ahead_m
        )


def _drive(
    state: Tensor, speed: Tensor, turn_rate: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return (x, y, θ) after a step; `scale` is λ·dt."""
    heading = state[..., 2]
    step_m = scale * speed
    x = state[..., 0] + step_m * heading.cos()
    y = state[..., 1] + step_m * heading.sin()
    return x, y, heading + scale * turn_rate


def steps_in(time_s: float, dt_s: float) -> int:
    """Return the number of time steps in a duration, rounded, at least 1."""
    return max(1, round(time_s / dt_s))


def component_wise(values: Tensor) -> Tensor:
    """Return states or actions [*B, S] in the memory layout that a `Robot` returns.

    Each component is contiguous in memory; see `_stack`.
    """
    return values.movedim(-1, 0).contiguous().movedim(0, -1)


def _stack(parts: tuple[Tensor, ...]) -> Tensor:
    # The component dimension is outermost in memory, so that each component is
    # contiguous. This makes compiled rollouts four times faster.
    components = torch.broadcast_tensors(*parts)
    return torch.stack(components).movedim(0, -1)


def _check_bounds(name: str, bounds: tuple[float, float]) -> None:
    low, high = bounds
    expect(
        low < high,
        f"`{name}` as (minimum, maximum), with the minimum below the maximum, got "
        f"{bounds}.",
    )
