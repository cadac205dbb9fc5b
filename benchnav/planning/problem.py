"""The navigation problem of a planner (paper, equation 2).

A problem contains only predictions; only the simulation contains the true λ. Letters in
shapes: B episodes, H×W cells, M fields, N cells of a padded map, S state and A action
dimensions, *K any further dimensions.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Protocol, Self

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError, expect
from benchnav.core.grid import Grid
from benchnav.core.terrain import Observation
from benchnav.planning.footprint import minimum_over_footprint
from benchnav.planning.free_space import PENALTY, Immobile, Rules, cells_at_goal
from benchnav.planning.objective import Objective
from benchnav.planning.robots import Robot

# Value for λ̂ = 0 in padded maps. There the sign marks free cells, and 0 means "off the
# map".
_ZERO = 1e-30


class FieldSource(Protocol):
    """Source of λ fields of B episodes, such as `sensing.belief.Fields`."""

    def sample(self, count: int, key: int, cells: Tensor | None = None) -> Tensor:
        """Draw fields; see `Problem.sample_fields`."""

    def select(self, members: Tensor) -> Self:
        """Return the source of the episodes at these indices (int64)."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """Task of a robot.

    Args:
        robot: robot with the motion F, its action bounds and its time step.
        objective: objective J.
        rules: free space, `min_traversability` and goal radius.
    """

    robot: Robot
    objective: Objective
    rules: Rules = field(default_factory=Rules)

    @property
    def inflation_m(self) -> float:
        """Radius in metres by which planners inflate maps; 0 for a point robot."""
        footprint = self.robot.footprint
        if footprint is None or self.rules.inflation == "none":
            return 0.0
        return footprint.radius_m

    def inflate(self, values: Tensor, grid: Grid) -> Tensor:
        """Return the minimum of maps over the robot's footprint in each cell.

        Args:
            values: maps of λ̂ or masks of free cells, shape [*K, H, W]. A point robot
                leaves them unchanged.
            grid: size and resolution of the maps.
        """
        return minimum_over_footprint(values, grid, self.inflation_m)


@dataclass(frozen=True, kw_only=True)
class Problem(Batch):
    """A batch of navigation problems on maps of one grid; `pose_problem` creates one.

    Args:
        task: the task.
        observation: the robots' observation.
        distribution: the predicted distribution of λ, shape [B, H, W].
        risk_map: λ̂ of the risk setting, in [0, 1], inflated by the robot's footprint,
            shape [B, H, W].
        free: mask of free cells (S_free in the paper), inflated likewise, and including
            the goal's disc, bool, shape [B, H, W].
        start: initial states, shape [B, S].
        goal_m: goals (x, y) in metres, shape [B, 2].
        time_budget_s: T of each episode in seconds, shape [B].
        fields: source of correlated fields of λ; see `sample_fields`. None if no
            planner uses fields.
        immobile: the world's rule of immobilisation, which planners may consider; None
            if nothing immobilises robots.
    """

    task: Task
    observation: Observation
    distribution: TraversabilityDistribution
    risk_map: Tensor
    free: Tensor
    start: Tensor
    goal_m: Tensor
    time_budget_s: Tensor
    fields: FieldSource | None = None
    immobile: Immobile | None = None

    def __post_init__(self) -> None:
        """Check that all tensors have the same number of episodes and cells."""
        n_episodes = self.start.shape[0]
        map_shape = n_episodes, *self.grid.shape
        expected = {
            "distribution": map_shape,
            "risk_map": map_shape,
            "free": map_shape,
            "goal_m": (n_episodes, 2),
            "time_budget_s": (n_episodes,),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            expect(
                value.shape == shape,
                f"`{name}` of shape {list(shape)}, got {list(value.shape)}.",
            )

    def __len__(self) -> int:
        """Number of episodes B."""
        return self.start.shape[0]

    @property
    def grid(self) -> Grid:
        """Size and resolution of the maps."""
        return self.observation.grid

    @property
    def elevation_m(self) -> Tensor:
        """Elevation in metres, shape [B, H, W]."""
        return self.observation.elevation_m

    @property
    def robot(self) -> Robot:
        """Robot with the motion F."""
        return self.task.robot

    @property
    def objective(self) -> Objective:
        """J, without the penalty of non-free cells: see `stage_cost`."""
        return self.task.objective

    @property
    def goal_radius_m(self) -> float:
        """Distance to the goal in metres below which a robot has reached it."""
        return self.task.rules.goal_radius_m

    @property
    def dt_s(self) -> float:
        """Time step of the robot in seconds."""
        return self.robot.dt_s

    def sample_fields(
        self, count: int, key: int, cells: Tensor | None = None
    ) -> Tensor:
        """Draw correlated fields of λ from the belief, inflated like `risk_map`.

        Args:
            count: number of fields M.
            key: stream key, see `benchnav.core.rng`; each key draws different fields.
            cells: mask of the cells whose λ is needed, bool, shape [B, H, W]; λ of
                other cells is then undefined, which may save time. None for all cells.

        Returns:
            λ in [0, 1], shape [B, M, H, W]; the fields of an episode do not depend on
            other episodes.

        Raises:
            ConfigError: If the problem has no `fields`.
        """
        if self.fields is None:
            raise ConfigError(
                "Expected a problem with `fields` to draw from, got None. Pass them "
                "to `pose_problem`."
            )
        if cells is not None:
            # A cell is needed if its value changes the minimum in a needed cell.
            cells = ~self.task.inflate(~cells, self.grid)
        fields = self.fields.sample(count, key, cells).to(self.risk_map)
        return self.task.inflate(fields, self.grid)

    def select(self, members: Tensor) -> "Problem":
        """Return the problems of the episodes at these indices (int64)."""
        selected = super().select(members)
        if self.fields is None:
            return selected
        return replace(selected, fields=self.fields.select(members))

    @cached_property
    def traversability(self) -> Tensor:
        """λ̂ of motion and path costs, at least `min_traversability`, shape [B, H, W].

        J uses `risk_map` itself, so that it can penalise lower λ̂.
        """
        return self.risk_map.clamp(min=self.task.rules.min_traversability)

    @cached_property
    def padded_ground(self) -> Tensor:
        """λ̂ and free mask in one padded map, shape [B, N].

        A value is λ̂ in free cells, −λ̂ in non-free cells, and −0 off the map. Hence
        one lookup per step provides motion, J and the penalty of non-free cells; see
        `motion_traversability`, `stage_cost` and `free_at`.
        """
        return ground_map(self.grid, self.risk_map, self.free)

    @cached_property
    def action_bounds(self) -> tuple[Tensor, Tensor]:
        """Minimum and maximum actions, each of shape [A]."""
        low = self.start.new_tensor(self.robot.action_low)
        high = self.start.new_tensor(self.robot.action_high)
        return low, high

    @property
    def dynamics(self) -> "Dynamics":
        """Grid, robot and objective, for compiled rollouts."""
        min_traversability = self.task.rules.min_traversability
        return Dynamics(self.grid, self.robot, self.objective, min_traversability)

    def ground_at(self, state: Tensor) -> Tensor:
        """Return `padded_ground` at states [B, *K, S], shape [B, *K]."""
        return self.grid.lookup(self.padded_ground, state[..., 0], state[..., 1])

    def traversability_at(self, state: Tensor) -> Tensor:
        """Return λ̂ that scales motion at states [B, *K, S], 0 off the map, [B, *K]."""
        min_traversability = self.task.rules.min_traversability
        return motion_traversability(self.ground_at(state), min_traversability)

    def free_at(self, state: Tensor) -> Tensor:
        """Return a mask of states [B, *K, S] in free cells, bool, shape [B, *K]."""
        return self.ground_at(state) > 0

    def stage_cost(
        self, state: Tensor, action: Tensor, ground: Tensor, target: Tensor
    ) -> Tensor:
        """Return J of a step, plus the penalty in a non-free cell.

        Args:
            state: states, shape [B, *K, S].
            action: actions, shape [B, *K, A].
            ground: `ground_at(state)`, shape [B, *K].
            target: target (x, y) in metres; its shape [B, …, 2] broadcasts to
                [B, *K, 2].

        Returns:
            Cost, shape [B, *K].
        """
        return stage_cost(self.objective, state, action, ground, target)

    def terminal_cost(self, state: Tensor, target: Tensor) -> Tensor:
        """Return the terminal J, plus the penalty in a non-free cell.

        The arguments and the result have the same shapes as those of `stage_cost`.
        """
        ground = self.ground_at(state)
        return terminal_cost(self.objective, state, ground, target)


class Dynamics(NamedTuple):
    """Inputs of a compiled rollout, except its maps.

    Args:
        grid: size and resolution of the maps.
        robot: robot with the motion F.
        objective: objective J.
        min_traversability: minimum λ̂ that scales motion.
    """

    grid: Grid
    robot: Robot
    objective: Objective
    min_traversability: float


def ground_map(grid: Grid, traversability: Tensor, free: Tensor) -> Tensor:
    """Return `Problem.padded_ground` for given λ and free mask, both [*B, H, W]."""
    magnitude = traversability.clamp(min=_ZERO)
    return grid.pad(torch.where(free, magnitude, -magnitude), outside=-0.0)


def motion_traversability(ground: Tensor, min_traversability: float) -> Tensor:
    """Return λ̂ that scales motion: at least a minimum on the map, 0 off it.

    Args:
        ground: values of `Problem.padded_ground`, any shape.
        min_traversability: minimum λ̂ of the task's rules.

    Returns:
        λ̂, shape of `ground`.
    """
    traversability = ground.abs().clamp(min=min_traversability)
    return torch.where(ground == 0, 0, traversability)


def predicted_traversability(ground: Tensor) -> Tensor:
    """Return λ̂ of the risk map, 0 off the map, from values of `padded_ground`."""
    magnitude = ground.abs()
    return torch.where(magnitude <= _ZERO, 0, magnitude)


def stage_cost(
    objective: Objective, state: Tensor, action: Tensor, ground: Tensor, target: Tensor
) -> Tensor:
    """Return J of a step plus the penalty; see `Problem.stage_cost`."""
    traversability = predicted_traversability(ground)
    cost = objective.stage(state, action, traversability, target)
    return cost + PENALTY * (ground <= 0)


def terminal_cost(
    objective: Objective, state: Tensor, ground: Tensor, target: Tensor
) -> Tensor:
    """Return the terminal J plus the penalty; see `Problem.terminal_cost`."""
    traversability = predicted_traversability(ground)
    cost = objective.terminal(state, traversability, target)
    return cost + PENALTY * (ground <= 0)


@dataclass(frozen=True)
class Prediction:
    """Prediction of B maps.

    Args:
        observation: the robots' observation.
        distribution: the predicted distribution of λ, shape [B, H, W].
        risk_map: λ̂ of each cell under the risk setting, in [0, 1], shape [B, H, W].
        free: mask of free cells, before inflation and before the cells at the goal are
            set free, bool, shape [B, H, W]; None to derive it by the rules of the task.
        fields: source of correlated fields of λ; None if no planner uses them.
    """

    observation: Observation
    distribution: TraversabilityDistribution
    risk_map: Tensor
    free: Tensor | None = None
    fields: FieldSource | None = None


def pose_problem(
    task: Task,
    prediction: Prediction,
    start_m: Tensor,
    goal_m: Tensor,
    time_budget_s: Tensor | float,
    immobile: Immobile | None = None,
) -> Problem:
    """Return the problem of driving from start to goal, initially facing the goal.

    λ̂ and free cells are inflated by the footprint of the task's robot.

    Args:
        task: the task.
        prediction: prediction of B maps.
        start_m: starts (x, y) in metres, shape [B, 2].
        goal_m: goals (x, y) in metres, shape [B, 2].
        time_budget_s: time budget T in seconds, a number or a tensor of shape [B].
        immobile: the world's rule of immobilisation; None if nothing immobilises
            robots.
    """
    rules = task.rules
    observation = prediction.observation
    free = prediction.free
    if free is None:
        free = rules.free(prediction.risk_map, prediction.distribution)
    grid = observation.grid
    at_goal = cells_at_goal(grid, goal_m, rules.goal_radius_m)
    pose = heading_to(start_m, goal_m)
    device = goal_m.device
    budget_s = torch.as_tensor(time_budget_s, dtype=torch.float64, device=device)
    return Problem(
        task=task,
        observation=observation,
        distribution=prediction.distribution,
        risk_map=task.inflate(prediction.risk_map, grid),
        free=task.inflate(free, grid) | at_goal,
        start=task.robot.initial_state(pose),
        goal_m=goal_m,
        time_budget_s=budget_s.expand(len(goal_m)).clone(),
        fields=prediction.fields,
        immobile=immobile,
    )


def heading_to(position_m: Tensor, goal_m: Tensor) -> Tensor:
    """Return poses (x, y, θ) facing the goal, shape [B, 3], at positions [B, 2]."""
    offset = goal_m - position_m
    heading = torch.atan2(offset[:, 1], offset[:, 0])
    return torch.cat((position_m, heading[:, None]), dim=1)
