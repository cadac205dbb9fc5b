"""The simulation: true episodes, stepped as one batch.

It holds the true terrain; λ is read where the robot stands and scales its motion.
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
    """Where a batch of episodes stands.

    Args:
        state: robot states, shape [B, S].
        outcome: `Outcome` of each, int64, shape [B].
        step: steps taken by each, int64, shape [B].
        held: steps in a row, up to now, on ground that immobilises a robot, int64,
            shape [B].
    """

    state: Tensor
    outcome: Tensor
    step: Tensor
    dwell_steps: Tensor

    @property
    def running(self) -> Tensor:
        """Which episodes go on, bool, shape [B]."""
        return self.outcome == Outcome.RUNNING


class Simulation:
    """B true episodes on B maps.

    Args:
        terrain: the true maps.
        task: robot, goal radius; the same that planners are given.
        world: what λ does.
        places: starts and goals.
        noise_key: root key of the noise; see `rng.stream_key`.
        maps: names each episode's stream under that root, B of them.

    Attributes:
        robot: F.
        time_budget_s: T of each episode, shape [B].
        steps: T in time steps, int64, shape [B].
        field: the λ of every cell where it stays what it is, shape [B, H, W]; None
            where it is resampled.
        attempts: how many fields were drawn until ground joined start and goal, int64,
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
        """Draws all noise."""
        self.robot = task.robot
        self.time_budget_s = world.budget_s(
            places.reference_time_s, task.robot.top_speed_mps
        )
        self.steps = world.steps(self.time_budget_s, task.robot.dt_s)
        self._grid, self._goal_m, self._goal_radius_m = (
            terrain.grid,
            places.goal_m,
            task.rules.goal_radius_m,
        )
        self._realisation = Realisation(
            terrain, world, places, int(self.steps.max()), noise_key, maps
        )
        # Which `exchange_` changes in place.
        self.field, self.attempts = self._realisation.field, self._realisation.attempts
        self._immobile = world.immobile
        self._low = places.goal_m.new_tensor(task.robot.action_low)
        self._high = places.goal_m.new_tensor(task.robot.action_high)

    @property
    def immobilising(self) -> Tensor:
        """Cells that immobilise a robot, bool, shape [B, H, W]; none where λ is
        resampled or nothing immobilises.
        """
        if self.field is None or self._immobile is None:
            return self._goal_m.new_zeros(len(self._goal_m), *self._grid.shape).bool()
        return self.field < self._immobile.below

    def field_at(self, step: int) -> Tensor:
        """λ of every cell at a step, shape [B, H, W]; where it is resampled, as every
        robot would meet it then.
        """
        return self._realisation.field_at(step) if self.field is None else self.field

    def init(self, start: Tensor) -> SimulationState:
        """Puts the robots at their initial states, shape [B, S]."""
        zero = torch.zeros(len(start), dtype=torch.int64, device=start.device)
        return SimulationState(start.clone(), zero, zero, zero)

    def step(
        self, now: SimulationState, action: Tensor
    ) -> tuple[SimulationState, Tensor]:
        """Advances the running episodes by one step; ended ones stay as they are.

        Args:
            now: where the episodes stand; not changed.
            action: shape [B, A]; clipped to the bounds.

        Returns:
            Where they stand next, and the λ that each robot met, shape [B].
        """
        traversability = self._realisation.at(now.state, now.step)
        # A robot of a user's may write into what it is given.
        moved = self.robot(
            now.state.clone(), action.clamp(self._low, self._high), traversability
        )
        state = torch.where(now.running[:, None], moved, now.state)
        step = now.step + now.running
        arrived = distance(state, self._goal_m) < self._goal_radius_m
        inside = self._grid.contains(state[:, 0], state[:, 1])
        outcome = torch.where(step >= self.steps, Outcome.TIMEOUT, Outcome.RUNNING)
        dwell_steps = now.dwell_steps
        if self._immobile is not None:
            dwell_steps = torch.where(
                traversability < self._immobile.below, dwell_steps + 1, 0
            )
            max_steps = steps_in(self._immobile.for_s, self.robot.dt_s)
            outcome = torch.where(
                dwell_steps >= max_steps, Outcome.IMMOBILISED, outcome
            )
        outcome = torch.where(inside, outcome, Outcome.OUT_OF_BOUNDS)
        outcome = torch.where(arrived, Outcome.SUCCESS, outcome)
        outcome = torch.where(now.running, outcome, now.outcome)
        return SimulationState(state, outcome, step, dwell_steps), traversability

    def unhindered(self, now: SimulationState, action: Tensor) -> Tensor:
        """Where an action would take the robots on ground of λ = 1, shape [B, S]; what
        was commanded.
        """
        ones = torch.ones_like(now.state[:, 0])
        return self.robot(now.state.clone(), action.clamp(self._low, self._high), ones)

    def exchange_(self, members: Tensor, others: "Simulation") -> None:
        """Gives some episodes the maps, goals and noise of another simulation, in
        place; the rest keep theirs.

        Args:
            members: indices of the episodes, int64, shape [M].
            others: M episodes of the same task and world.
        """
        for name in ("_goal_m", "time_budget_s", "steps"):
            setattr(
                self,
                name,
                getattr(self, name).index_copy(0, members, getattr(others, name)),
            )
        self._realisation.exchange_(members, others._realisation)


def end(now: SimulationState, which: Tensor, outcome: Outcome) -> SimulationState:
    """Ends running episodes, bool [B], with an outcome that the simulation cannot see
    itself.
    """
    return replace(now, outcome=torch.where(now.running & which, outcome, now.outcome))
