"""Robots: state transitions F under actions and traversability.

A robot is a `Robot`, with the members listed there and

    F(state [*B, S], action [*B, A], traversability [*B]) -> state [*B, S]

where a state begins with (x, y, θ) in metres and radians. The same F serves the
planners, with predicted traversability, and the simulation, with the true one. Sources:
paper II and IV-A; Rajamani (2012), "Vehicle dynamics and control", section 2.2
(bicycle). Letters in shapes: *B any leading dimensions, S state and A action
dimensions.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.errors import expect
from benchnav.core.specified import Specified

# Names of actions, by which planners know their meaning.
SPEED, TURN_RATE, STEERING = "speed_mps", "turn_rate_radps", "steering_rad"


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
        """Names of the A actions, with units, by which planners choose how to steer."""

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

    @abstractmethod
    def initial_state(self, pose: Tensor) -> Tensor:
        """Return the states of robots standing at poses (x, y, θ), [B, S] from [B, 3]."""

    @abstractmethod
    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Return the state after one time step.

        Args:
            state: states that begin with (x, y, θ), shape [*B, S].
            action: actions, shape [*B, A].
            traversability: λ at the robots' positions, in [0, 1], shape [*B].

        Returns:
            The next state, shape [*B, S]; no argument is changed.
        """


@dataclass(frozen=True, kw_only=True)
class _Vehicle(Robot):
    """Common part of the shipped robots: a bounded speed, and a state that begins with
    the pose.
    """

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
        """Return the pose; see `Robot`."""
        return pose.clone()


@dataclass(frozen=True, kw_only=True)
class Unicycle(_Vehicle):
    """The paper's unicycle: traversability scales both the linear and the angular
    velocity.

    State (x, y, θ), action (v, ω). Source: paper IV-A.

    Args:
        dt_s: time step.
        speed_mps: least and greatest linear velocity v.
        turn_rate_radps: least and greatest angular velocity ω.
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
        return _stack(
            _drive(state, action[..., 0], action[..., 1], traversability * self.dt_s)
        )


@dataclass(frozen=True, kw_only=True)
class DifferentialDrive(Unicycle):
    """A differential drive: a unicycle whose velocities follow the command within
    accelerations.

    State (x, y, θ, v, ω), action (v, ω) as commanded. The velocities in the state are
    those of the wheels; traversability scales the motion over ground.

    Args:
        dt_s: time step.
        speed_mps: least and greatest linear velocity v.
        turn_rate_radps: least and greatest angular velocity ω.
        acceleration_mps2: greatest change of v.
        turn_acceleration_radps2: greatest change of ω.
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
        return torch.cat((pose, torch.zeros_like(pose[..., :2])), dim=-1)

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Return the state after one time step; see `Robot`."""
        reach, turn_reach = (
            self.acceleration_mps2 * self.dt_s,
            self.turn_acceleration_radps2 * self.dt_s,
        )
        speed = state[..., 3] + (action[..., 0] - state[..., 3]).clamp(-reach, reach)
        turn_rate = state[..., 4] + (action[..., 1] - state[..., 4]).clamp(
            -turn_reach, turn_reach
        )
        return _stack(
            (
                *_drive(state, speed, turn_rate, traversability * self.dt_s),
                speed,
                turn_rate,
            )
        )


@dataclass(frozen=True, kw_only=True)
class Bicycle(_Vehicle):
    """A kinematic bicycle, referred to the rear axle: it turns only while it drives.

    State (x, y, θ), action (v, δ) with θ' = v tan(δ) / wheelbase; traversability scales
    v, and with it the
    turn. Source: Rajamani (2012).

    Args:
        dt_s: time step.
        speed_mps: least and greatest velocity v of the rear axle.
        steering_rad: greatest steering angle δ, to both sides.
        wheelbase_m: distance of the axles.
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
        turn_rate = action[..., 0] * action[..., 1].tan() / self.wheelbase_m
        return _stack(
            _drive(state, action[..., 0], turn_rate, traversability * self.dt_s)
        )


def _drive(
    state: Tensor, speed: Tensor, turn_rate: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return (x, y, θ) after a step; `scale` is λ·dt."""
    x, y, heading = state[..., 0], state[..., 1], state[..., 2]
    moved = scale * speed
    return (
        x + moved * heading.cos(),
        y + moved * heading.sin(),
        heading + scale * turn_rate,
    )


def steps_in(time_s: float, dt_s: float) -> int:
    """Return the number of time steps in a duration: the nearest, at least one."""
    return max(1, round(time_s / dt_s))


def component_wise(values: Tensor) -> Tensor:
    """The same states or actions, shape [*B, S], laid out in memory as `Robot` returns
    them, see `_stack`.
    """
    return values.movedim(-1, 0).contiguous().movedim(0, -1)


def _stack(parts: tuple[Tensor, ...]) -> Tensor:
    # Stacked outermost in memory, each component is contiguous: compiled rollouts are
    # four times faster.
    return torch.stack(torch.broadcast_tensors(*parts)).movedim(0, -1)


def _check_bounds(name: str, bounds: tuple[float, float]) -> None:
    expect(bounds[0] < bounds[1], f"`{name}` as (least, greatest), got {bounds}.")
