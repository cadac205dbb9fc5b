"""State transitions F: what an action does to a robot on ground of some traversability.

A dynamics is any object with action bounds, a time step and

    F(state [*B, S], action [*B, A], traversability [*B]) -> state [*B, S]

where a state begins with (x, y, θ) in metres and radians. The same F serves the planners, with
predicted traversability, and the simulation, with the true one. Source: paper II and IV-A.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from benchnav.errors import ConfigError


class Dynamics(Protocol):
    """The contract of a robot model F."""

    @property
    def dt_s(self) -> float:
        """Time step in seconds."""
        ...

    @property
    def action_low(self) -> tuple[float, ...]:
        """Least value of each action, A of them."""
        ...

    @property
    def action_high(self) -> tuple[float, ...]:
        """Greatest value of each action, A of them."""
        ...

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Advances one time step.

        Args:
            state: shape [*B, S], beginning with (x, y, θ).
            action: shape [*B, A].
            traversability: λ where the robot stands, in [0, 1], shape [*B].

        Returns:
            The next state, shape [*B, S]; no argument is changed.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Unicycle:
    """The paper's unicycle: traversability scales both the linear and the angular velocity.

    State (x, y, θ), action (v, ω). Source: paper IV-A.

    Args:
        dt_s: time step.
        speed_mps: least and greatest linear velocity v.
        turn_rate_radps: least and greatest angular velocity ω.
    """

    dt_s: float = 0.1
    speed_mps: tuple[float, float] = (0.0, 1.0)
    turn_rate_radps: tuple[float, float] = (-1.0, 1.0)

    def __post_init__(self) -> None:
        """Refuses a time step or bounds that allow no motion."""
        if self.dt_s <= 0:
            raise ConfigError(f"Expected `dt_s` > 0, got {self.dt_s}.")
        for name in ("speed_mps", "turn_rate_radps"):
            low, high = getattr(self, name)
            if not low < high:
                raise ConfigError(f"Expected `{name}` as (least, greatest), got {(low, high)}.")

    @property
    def action_low(self) -> tuple[float, float]:
        """Least (v, ω)."""
        return self.speed_mps[0], self.turn_rate_radps[0]

    @property
    def action_high(self) -> tuple[float, float]:
        """Greatest (v, ω)."""
        return self.speed_mps[1], self.turn_rate_radps[1]

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Advances one time step; see `Dynamics`."""
        x, y, heading = state[..., 0], state[..., 1], state[..., 2]
        moved = self.dt_s * traversability * action[..., 0]
        turned = self.dt_s * traversability * action[..., 1]
        # Stacked outermost in memory, each component is contiguous: compiled rollouts are four times faster.
        parts = (x + moved * heading.cos(), y + moved * heading.sin(), heading + turned)
        return torch.stack(parts).movedim(0, -1)
