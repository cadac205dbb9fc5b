"""Simulation of true episodes, stepped as one batch.

The simulation contains the true terrain. λ at the robot's position scales its motion.
Letters in shapes: B episodes, S state and A action dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.terrain import Terrain
from benchnav.planning.objective import distance
from benchnav.planning.problem import Task
from benchnav.planning.robots import steps_in
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.realisation import Realisation
from benchnav.planning.world.world import Endpoints, World


@dataclass(frozen=True)
class SimulationState:
    """State of a batch of episodes.

    Args:
        state: robot states, shape [B, S].
        outcome: `Outcome` of each episode, int64, shape [B].
        step: number of steps taken in each episode, int64, shape [B].
        dwell_steps: consecutive steps on immobilising terrain, int64, shape [B].
    """

    state: Tensor
    outcome: Tensor
    step: Tensor
    dwell_steps: Tensor

    @property
    def running(self) -> Tensor:
        """Mask of episodes that have not ended, bool, shape [B]."""
        return self.outcome == Outcome.RUNNING


class Simulation:
    """B true episodes on B maps.

    Args:
        terrain: the true maps.
        task: robot and goal radius, the same as for planners.
        world: the model of λ.
        places: starts and goals.
        noise_key: root key of the noise; see `rng.stream_key`.
        maps: index of each episode's stream under that root, B of them.

    Attributes:
        robot: robot with the motion F.
        time_budget_s: time budget T of each episode in seconds, shape [B].
        steps: T in time steps, int64, shape [B].
        field: λ of all cells if it is constant, shape [B, H, W]; None if it is
            resampled.
        attempts: number of fields drawn until one connected start and goal, int64,
            shape [B].
    """

    def __init__(
        self,
        terrain: Terrain,
        task: Task,
        world: World,
        places: Endpoints,
        noise_key: int,
        maps: Sequence[int],
    ) -> None:
        """Draw all noise."""
        robot = task.robot
        goal_m = places.goal_m
        self.robot = robot
        self.time_budget_s = world.budget_s(
            places.reference_time_s, robot.top_speed_mps
        )
        self.steps = world.steps(self.time_budget_s, robot.dt_s)
        self._grid = terrain.grid
        self._goal_m = goal_m
        self._goal_radius_m = task.rules.goal_radius_m
        max_steps = int(self.steps.max())
        realisation = Realisation(terrain, world, places, max_steps, noise_key, maps)
        self._realisation = realisation
        # `exchange_` of the realisation modifies both in place.
        self.field = realisation.field
        self.attempts = realisation.attempts
        self._immobile = world.immobile
        self._low = goal_m.new_tensor(robot.action_low)
        self._high = goal_m.new_tensor(robot.action_high)

    @property
    def immobilising(self) -> Tensor:
        """Mask of immobilising cells, bool, shape [B, H, W].

        No cell is immobilising if λ is resampled or the world does not immobilise
        robots.
        """
        if self.field is None or self._immobile is None:
            shape = len(self._goal_m), *self._grid.shape
            return self._goal_m.new_zeros(shape).bool()
        return self.field < self._immobile.below

    def field_at(self, step: int) -> Tensor:
        """Return λ of all cells at a step, shape [B, H, W]."""
        if self.field is not None:
            return self.field
        return self._realisation.field_at(step)

    def init(self, start: Tensor) -> SimulationState:
        """Return the state at the start, from robot states [B, S]."""
        zero = torch.zeros(len(start), dtype=torch.int64, device=start.device)
        return SimulationState(start.clone(), zero, zero, zero)

    def step(
        self, now: SimulationState, action: Tensor
    ) -> tuple[SimulationState, Tensor]:
        """Advance the running episodes by one step; ended ones do not change.

        Args:
            now: current state; not modified.
            action: actions, clipped to the bounds, shape [B, A].

        Returns:
            The next state, and λ under each robot in this step, shape [B].
        """
        traversability = self._realisation.at(now.state, now.step)
        # A user's robot may write into its arguments.
        action = action.clamp(self._low, self._high)
        moved = self.robot(now.state.clone(), action, traversability)
        state = torch.where(now.running[:, None], moved, now.state)
        step = now.step + now.running
        arrived = distance(state, self._goal_m) < self._goal_radius_m
        inside = self._grid.contains(state[:, 0], state[:, 1])
        outcome = torch.where(step >= self.steps, Outcome.TIMEOUT, Outcome.RUNNING)
        dwell_steps = now.dwell_steps
        immobile = self._immobile
        if immobile is not None:
            immobilises = traversability < immobile.below
            dwell_steps = torch.where(immobilises, dwell_steps + 1, 0)
            is_stuck = dwell_steps >= steps_in(immobile.for_s, self.robot.dt_s)
            outcome = torch.where(is_stuck, Outcome.IMMOBILISED, outcome)
        outcome = torch.where(inside, outcome, Outcome.OUT_OF_BOUNDS)
        outcome = torch.where(arrived, Outcome.SUCCESS, outcome)
        outcome = torch.where(now.running, outcome, now.outcome)
        return SimulationState(state, outcome, step, dwell_steps), traversability

    def unhindered(self, now: SimulationState, action: Tensor) -> Tensor:
        """Return the commanded motion: states after an action at λ = 1, shape [B, S]."""
        ones = torch.ones_like(now.state[:, 0])
        action = action.clamp(self._low, self._high)
        return self.robot(now.state.clone(), action, ones)

    def exchange_(self, members: Tensor, others: "Simulation") -> None:
        """Replace episodes by those of another simulation, in place.

        Args:
            members: indices of the episodes, int64, shape [M].
            others: simulation of M episodes of the same task and world.
        """
        for name in ("_goal_m", "time_budget_s", "steps"):
            values = getattr(self, name)
            other_values = getattr(others, name)
            setattr(self, name, values.index_copy(0, members, other_values))
        self._realisation.exchange_(members, others._realisation)


def end(now: SimulationState, which: Tensor, outcome: Outcome) -> SimulationState:
    """Return the state with some running episodes ended by an outcome.

    Args:
        now: current state.
        which: mask of the episodes, bool, shape [B].
        outcome: an outcome that the simulation cannot determine itself.
    """
    ends = now.running & which
    return replace(now, outcome=torch.where(ends, outcome, now.outcome))
