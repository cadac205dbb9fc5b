"""Simulation of episodes on the true terrain, stepped as one batch.

The true λ at a robot's position scales its motion. Letters in shapes: B episodes, H×W
cells, S state and A action dimensions.
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

# A step that commands less motion of the faster side observes nothing.
MIN_WHEEL_SPEED_MPS = 0.05
# Distance of the sides of a robot without a footprint, for its wheel speed (choice).
POINT_TRACK_M = 0.5


@dataclass(frozen=True)
class SimulationState:
    """State of a batch of episodes.

    Args:
        state: robot states, shape [B, S].
        outcome: `Outcome` of each episode, int64, shape [B].
        step: number of simulated steps of each episode, int64, shape [B].
        dwell_steps: number of the last consecutive steps on immobilising terrain,
            int64, shape [B].
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
    """B episodes on the true terrain of B maps.

    Args:
        terrain: terrain of the B maps.
        task: task with the robot and the goal radius that planners also receive.
        world: model of λ.
        places: start, goal and reference time of each episode.
        noise_key: root key of the noise; see `rng.stream_key`.
        maps: indices of B maps; an episode draws its noise from the root key and the
            index of its map.

    Attributes:
        robot: robot with the motion F.
        time_budget_s: time budget T of each episode in seconds, shape [B].
        steps: T of each episode as a number of time steps, int64, shape [B].
        field: λ of all cells, shape [B, H, W]; None if λ is resampled at each step.
        attempts: number of fields that were drawn for each episode until start and goal
            were connected, int64, shape [B].
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
        # `Realisation.exchange_` modifies these two tensors in place.
        self.field = realisation.field
        self.attempts = realisation.attempts
        self._immobile_rule = world.immobile
        self._low = goal_m.new_tensor(robot.action_low)
        self._high = goal_m.new_tensor(robot.action_high)

    @property
    def immobilising(self) -> Tensor:
        """Mask of cells that immobilise a robot, bool, shape [B, H, W].

        It is False everywhere if λ is resampled or the world does not immobilise
        robots.
        """
        if self.field is None or self._immobile_rule is None:
            shape = len(self._goal_m), *self._grid.shape
            return self._goal_m.new_zeros(shape).bool()
        return self.field < self._immobile_rule.below

    def field_at(self, step: int) -> Tensor:
        """Return λ of all cells at a step, counted from 0, shape [B, H, W]."""
        if self.field is not None:
            return self.field
        return self._realisation.field_at(step)

    def init(self, start: Tensor) -> SimulationState:
        """Return the state of episodes that start at robot states [B, S]."""
        zero = torch.zeros(len(start), dtype=torch.int64, device=start.device)
        return SimulationState(start.clone(), zero, zero, zero)

    def step(
        self, now: SimulationState, action: Tensor
    ) -> tuple[SimulationState, Tensor]:
        """Advance the running episodes by one step; ended episodes do not change.

        Args:
            now: current state; not modified.
            action: actions, which are clipped to the robot's bounds, shape [B, A].

        Returns:
            The next state, and the λ that each robot observed in this step, shape [B].
        """
        traversability = self._realisation.at(now.state, now.step)
        action = action.clamp(self._low, self._high)
        moved, observed = self._move(now, action, traversability)
        state = torch.where(now.running[:, None], moved.state, now.state)
        step = now.step + now.running
        is_at_goal = distance(state, self._goal_m) < self._goal_radius_m
        is_on_map = self._grid.contains(state[:, 0], state[:, 1])
        outcome = torch.where(step >= self.steps, Outcome.TIMEOUT, Outcome.RUNNING)
        dwell_steps = now.dwell_steps
        rule = self._immobile_rule
        if rule is not None:
            is_observed = rule.by == "observed"
            met = observed if is_observed else traversability
            counted = torch.where(met < rule.below, dwell_steps + 1, 0)
            if is_observed:
                is_commanded = self._wheel_speed(now, action) >= MIN_WHEEL_SPEED_MPS
                counted = torch.where(is_commanded, counted, dwell_steps)
            dwell_steps = counted
            is_immobilised = dwell_steps >= steps_in(rule.for_s, self.robot.dt_s)
            outcome = torch.where(is_immobilised, Outcome.IMMOBILISED, outcome)
        outcome = torch.where(is_on_map, outcome, Outcome.OUT_OF_BOUNDS)
        outcome = torch.where(is_at_goal, Outcome.SUCCESS, outcome)
        outcome = torch.where(now.running, outcome, now.outcome)
        after = replace(
            moved, state=state, outcome=outcome, step=step, dwell_steps=dwell_steps
        )
        return after, observed

    def _move(
        self, now: SimulationState, action: Tensor, traversability: Tensor
    ) -> tuple[SimulationState, Tensor]:
        """Return the state after the motion of a step, and the observed λ.

        Args:
            now: current state; not modified.
            action: actions within the bounds, shape [B, A].
            traversability: λ of the cell at each robot's position, shape [B].

        Returns:
            The state with the robots' new states, for all episodes, and with
            everything that the backend adds; and the achieved fraction of the commanded
            motion, shape [B].
        """
        moved = self.robot(now.state.clone(), action, traversability)
        return replace(now, state=moved), traversability

    def _velocity(self, now: SimulationState, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the commanded (v, ω): the motion at λ = 1, each of shape [B]."""
        before = now.state
        after = self.unhindered(now, action)
        heading = before[:, 2]
        x, y = (after[:, :2] - before[:, :2]).unbind(1)
        along_m = x * heading.cos() + y * heading.sin()
        dt_s = self.robot.dt_s
        return along_m / dt_s, (after[:, 2] - heading) / dt_s

    def _wheel_speed(self, now: SimulationState, action: Tensor) -> Tensor:
        """Return the speed of the faster side that is commanded, in m/s, shape [B]."""
        footprint = self.robot.footprint
        track_m = POINT_TRACK_M if footprint is None else footprint.track_m
        speed, turn_rate = self._velocity(now, action)
        return speed.abs() + turn_rate.abs() * track_m / 2

    def unhindered(self, now: SimulationState, action: Tensor) -> Tensor:
        """Return the states that an action would lead to at λ = 1, shape [B, S].

        Args:
            now: current state; not modified.
            action: actions, which are clipped to the robot's bounds, shape [B, A].
        """
        ones = torch.ones_like(now.state[:, 0])
        action = action.clamp(self._low, self._high)
        return self.robot(now.state.clone(), action, ones)

    def faults(self, now: SimulationState) -> list[str]:
        """Return a message for each episode whose simulation failed; otherwise empty.

        Such an episode has the outcome `MODEL_ERROR`.

        Args:
            now: current state; not modified.
        """
        return [""] * len(now.state)

    def drawn(self, now: SimulationState) -> dict[str, Tensor]:
        """Return the values that recordings keep of each step, to draw robots.

        Backends add values of their own.

        Args:
            now: current state; not modified.

        Returns:
            Values by name, floating-point, each of shape [B, ...]. For a robot with a
            footprint, `contacts_m` has the positions (x, y) of its contacts in metres,
            in the order of `Footprint.contacts`, shape [B, 4, 2]; for a point, there
            are no values.
        """
        footprint = self.robot.footprint
        if footprint is None:
            return {}
        return {"contacts_m": footprint.contacts(now.state).flatten(1, 2)}

    def exchange_(self, indices: Tensor, replacements: "Simulation") -> None:
        """Replace M episodes by those of another simulation, in place.

        Args:
            indices: indices of the replaced episodes, int64, shape [M].
            replacements: simulation of M episodes with the same task and world.
        """
        for name in ("_goal_m", "time_budget_s", "steps"):
            values = getattr(self, name)
            other_values = getattr(replacements, name)
            setattr(self, name, values.index_copy(0, indices, other_values))
        self._realisation.exchange_(indices, replacements._realisation)


def end(now: SimulationState, which: Tensor, outcome: Outcome) -> SimulationState:
    """Return a state in which the running episodes of a mask have ended.

    Args:
        now: current state; not modified.
        which: mask of the episodes to end, bool, shape [B].
        outcome: outcome of these episodes, which the simulation cannot determine, such
            as `Outcome.PLANNER_FAILURE`.
    """
    ends_now = now.running & which
    return replace(now, outcome=torch.where(ends_now, outcome, now.outcome))
