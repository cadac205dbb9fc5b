"""The simulation: true episodes, stepped as one batch.

It holds the true terrain; λ is read where the robot stands and scales its motion. Noise is
`resampled` at each step (the paper's protocol) or `frozen` (the map's realised λ). It is keyed by
(seed, names, instance, step), so every planner and setting meets the same luck. Low λ slows the
robot and ends nothing. Letters in shapes: B episodes, N steps, S state and A action dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import torch
from torch import Tensor

from benchnav import rng
from benchnav.errors import ConfigError
from benchnav.planning.dynamics import Dynamics
from benchnav.terrain import Terrain

STUCK_WINDOW_S = 10.0
STUCK_DISTANCE_M = 0.5


class Outcome(IntEnum):
    """How an episode stands, or how it ended."""

    RUNNING = 0
    SUCCESS = 1
    TIMEOUT = 2
    STUCK = 3  # a timeout whose last 10 s moved under 0.5 m
    OUT_OF_BOUNDS = 4
    PLANNER_FAILURE = 5


@dataclass(frozen=True, kw_only=True)
class SimulationConfig:
    """Settings of the simulation.

    Args:
        noise: `resampled` at each step, or `frozen` at the map's realised λ.
        goal_radius_m: a robot this near to the goal has arrived.
        time_budget_s: T.
    """

    noise: str = "resampled"
    goal_radius_m: float = 1.0
    time_budget_s: float = 100.0

    def __post_init__(self) -> None:
        """Refuses settings under which no episode can run."""
        if self.noise not in ("resampled", "frozen"):
            raise ConfigError(f"Expected `noise` 'resampled' or 'frozen', got {self.noise!r}.")
        if not 0 < self.goal_radius_m < np.inf or not 0 < self.time_budget_s < np.inf:
            raise ConfigError(
                f"Expected `goal_radius_m` and `time_budget_s` > 0 and finite, "
                f"got {self.goal_radius_m} and {self.time_budget_s}."
            )


def steps_in(config: SimulationConfig, dynamics: Dynamics) -> int:
    """Number of time steps in the time budget.

    Raises:
        ConfigError: there is none.
    """
    steps = round(config.time_budget_s / dynamics.dt_s)
    if steps < 1:
        raise ConfigError(
            f"Expected `time_budget_s` of at least one time step of {dynamics.dt_s:g} s, got {config.time_budget_s}."
        )
    return steps


@dataclass(frozen=True)
class SimulationState:
    """Where a batch of episodes stands.

    Args:
        state: robot states, shape [B, S].
        outcome: `Outcome` of each, int64, shape [B].
        step: steps taken by each, int64, shape [B].
    """

    state: Tensor
    outcome: Tensor
    step: Tensor

    @property
    def running(self) -> Tensor:
        """Which episodes go on, bool, shape [B]."""
        return self.outcome == Outcome.RUNNING


class Simulation:
    """B true episodes on B maps.

    Args:
        terrain: the true maps.
        dynamics: F, the same that planners are given.
        goal_m: goals, shape [B, 2].
        noise_key: root of the noise; see `rng.stream_key`.
        instances: names each episode's stream under that root, B of them.
        config: settings.
    """

    def __init__(
        self,
        terrain: Terrain,
        dynamics: Dynamics,
        goal_m: Tensor,
        noise_key: int,
        instances: Sequence[int],
        config: SimulationConfig | None = None,
    ) -> None:
        """Draws the luck of all steps."""
        self.config = config or SimulationConfig()
        self.dynamics = dynamics
        self.steps = steps_in(self.config, dynamics)
        self._grid = terrain.grid
        self._goal_m = goal_m
        if self.config.noise == "frozen":
            if bool(terrain.traversability.isnan().any()):
                raise ConfigError(
                    "Expected maps with λ in every cell for `noise` 'frozen', got some that were not observed. "
                    "Take `noise` 'resampled'."
                )
            self._mean = terrain.grid.pad(terrain.traversability, outside=0.0)
            self._std = torch.zeros_like(self._mean)
        else:
            self._mean = terrain.grid.pad(terrain.traversability_mean, outside=0.0)
            self._std = terrain.grid.pad(terrain.traversability_std, outside=0.0)
        # A stream each, so that another time budget leaves the luck of the first steps as it is.
        first = np.zeros(1, dtype=np.int64)
        luck = [rng.normal(rng.stream_key(noise_key, int(i)), first, (self.steps,)) for i in instances]
        self._noise = torch.from_numpy(np.concatenate(luck)).to(self._mean)

    def init(self, start: Tensor) -> SimulationState:
        """Puts the robots at their initial states, shape [B, S]."""
        zero = torch.zeros(len(start), dtype=torch.int64, device=start.device)
        return SimulationState(start.clone(), zero, zero)

    def step(self, now: SimulationState, action: Tensor) -> tuple[SimulationState, Tensor]:
        """Advances the running episodes by one step; ended ones stay as they are.

        Args:
            now: where the episodes stand; not changed.
            action: shape [B, A]; clipped to the bounds.

        Returns:
            Where they stand next, and the λ that each robot met, shape [B].
        """
        x, y = now.state[:, 0], now.state[:, 1]
        noise = self._noise.gather(1, now.step.clamp(max=self.steps - 1)[:, None])[:, 0]
        traversability = self._grid.lookup(self._mean, x, y) + self._grid.lookup(self._std, x, y) * noise
        traversability = traversability.clamp(0, 1)
        low, high = (action.new_tensor(b) for b in (self.dynamics.action_low, self.dynamics.action_high))
        moved = self.dynamics(now.state, action.clamp(low, high), traversability)
        state = torch.where(now.running[:, None], moved, now.state)
        step = now.step + now.running
        arrived = torch.linalg.vector_norm(state[:, :2] - self._goal_m, dim=1) < self.config.goal_radius_m
        inside = self._grid.contains(state[:, 0], state[:, 1])
        outcome = torch.where(step >= self.steps, Outcome.TIMEOUT, Outcome.RUNNING)
        outcome = torch.where(inside, outcome, Outcome.OUT_OF_BOUNDS)
        outcome = torch.where(arrived, Outcome.SUCCESS, outcome)
        return SimulationState(state, torch.where(now.running, outcome, now.outcome), step), traversability


def fail(now: SimulationState, failed: Tensor) -> SimulationState:
    """Ends the running episodes whose planner gave up, bool, shape [B]."""
    outcome = torch.where(now.running & failed, Outcome.PLANNER_FAILURE, now.outcome)
    return replace(now, outcome=outcome)


def tell_stuck(outcome: Tensor, positions_m: Tensor, dt_s: float) -> Tensor:
    """Tells stuck episodes from other timeouts.

    Args:
        outcome: shape [B].
        positions_m: shape [B, N + 1, 2], to the end of the time budget.
        dt_s: time step.

    Returns:
        Outcomes, shape [B].
    """
    window = positions_m[:, -(round(STUCK_WINDOW_S / dt_s) + 1) :]
    moved = torch.linalg.vector_norm(window - window[:, :1], dim=2).amax(dim=1)
    return torch.where((outcome == Outcome.TIMEOUT) & (moved < STUCK_DISTANCE_M), Outcome.STUCK, outcome)
