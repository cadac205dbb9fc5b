"""Robots: state transitions F, what an action does on ground of some traversability.

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

# How planners know what an action is.
SPEED, TURN_RATE, STEERING = "speed_mps", "turn_rate_radps", "steering_rad"


class Robot(Specified, ABC):
    """The base class of robots; `benchnav.testing.check_robot` tries whether one keeps
    its contract.

    What is listed as a property may also be a class attribute, or the field of a
    dataclass that has a default.
    """

    @property
    @abstractmethod
    def dt_s(self) -> float:
        """Time step in seconds."""

    @property
    @abstractmethod
    def action_names(self) -> tuple[str, ...]:
        """What each of the A actions is, with its unit; planners that steer go by these
        names.
        """

    @property
    @abstractmethod
    def action_low(self) -> tuple[float, ...]:
        """Least value of each action."""

    @property
    @abstractmethod
    def action_high(self) -> tuple[float, ...]:
        """Greatest value of each action."""

    @property
    @abstractmethod
    def top_speed_mps(self) -> float:
        """Greatest speed over ground of λ = 1."""

    @property
    def action_rates(self) -> tuple[float, ...] | None:
        """Greatest change of each action in a second; None where an action is followed
        at once.
        """
        return None

    @abstractmethod
    def initial_state(self, pose: Tensor) -> Tensor:
        """State of a robot that stands at a pose (x, y, θ): shape [B, S] from [B, 3]."""

    @abstractmethod
    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Advances one time step.

        Args:
            state: shape [*B, S], beginning with (x, y, θ).
            action: shape [*B, A].
            traversability: λ where the robot stands, in [0, 1], shape [*B].

        Returns:
            The next state, shape [*B, S]; no argument is changed.
        """


@dataclass(frozen=True, kw_only=True)
class _Vehicle(Robot):
    """What the shipped robots share: a speed within bounds, and a state that is or
    begins with the pose.
    """

    dt_s: float = 0.1
    speed_mps: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        """Refuses a time step or a speed that allows no motion."""
        expect(self.dt_s > 0, f"`dt_s` > 0, got {self.dt_s}.")
        _check_bounds("speed_mps", self.speed_mps)

    @property
    def top_speed_mps(self) -> float:
        """Greatest |v|."""
        return max(map(abs, self.speed_mps))

    def initial_state(self, pose: Tensor) -> Tensor:
        """The pose itself; see `Robot`."""
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
        """Refuses a time step or bounds that allow no motion."""
        super().__post_init__()
        _check_bounds("turn_rate_radps", self.turn_rate_radps)

    @property
    def action_low(self) -> tuple[float, ...]:
        """Least (v, ω)."""
        return self.speed_mps[0], self.turn_rate_radps[0]

    @property
    def action_high(self) -> tuple[float, ...]:
        """Greatest (v, ω)."""
        return self.speed_mps[1], self.turn_rate_radps[1]

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Advances one time step; see `Robot`."""
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
        """Refuses a robot that cannot move."""
        super().__post_init__()
        expect(
            self.acceleration_mps2 > 0 and self.turn_acceleration_radps2 > 0,
            "`acceleration_mps2` and `turn_acceleration_radps2` > 0, "
            f"got {self.acceleration_mps2} and {self.turn_acceleration_radps2}.",
        )

    @property
    def action_rates(self) -> tuple[float, ...]:
        """Greatest change of (v, ω) in a second."""
        return self.acceleration_mps2, self.turn_acceleration_radps2

    def initial_state(self, pose: Tensor) -> Tensor:
        """Stands still at the pose; see `Robot`."""
        return torch.cat((pose, torch.zeros_like(pose[..., :2])), dim=-1)

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Advances one time step; see `Robot`."""
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
        """Refuses a robot that cannot move or turn."""
        super().__post_init__()
        expect(
            0 < self.steering_rad < math.pi / 2 and self.wheelbase_m > 0,
            "`steering_rad` in (0, π/2) and `wheelbase_m` > 0, "
            f"got {self.steering_rad} and {self.wheelbase_m}.",
        )

    @property
    def action_low(self) -> tuple[float, ...]:
        """Least (v, δ)."""
        return self.speed_mps[0], -self.steering_rad

    @property
    def action_high(self) -> tuple[float, ...]:
        """Greatest (v, δ)."""
        return self.speed_mps[1], self.steering_rad

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Advances one time step; see `Robot`."""
        turn_rate = action[..., 0] * action[..., 1].tan() / self.wheelbase_m
        return _stack(
            _drive(state, action[..., 0], turn_rate, traversability * self.dt_s)
        )


def _drive(
    state: Tensor, speed: Tensor, turn_rate: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Moves (x, y, θ) for a step; `scale` is λ·dt."""
    x, y, heading = state[..., 0], state[..., 1], state[..., 2]
    moved = scale * speed
    return (
        x + moved * heading.cos(),
        y + moved * heading.sin(),
        heading + scale * turn_rate,
    )


def steps_in(time_s: float, dt_s: float) -> int:
    """Time steps in so many seconds, to the nearest number, one at least."""
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
