"""The navigation problem that a planner is given (paper, equation 2).

It holds what is *predicted* alone: the truth stays with the simulation. Letters in
shapes: B episodes, H×W cells, S state and A action dimensions, *K any further
dimensions.
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
from benchnav.planning.free_space import PENALTY, Immobile, Rules, cells_at_goal
from benchnav.planning.objective import Objective
from benchnav.planning.robots import Robot

# Stands for a λ̂ of 0 in maps for lookups, where the sign tells whether ground is free
# and 0 is off the map.
_ZERO = 1e-30


class FieldSource(Protocol):
    """Draws fields of λ for B episodes: `benchnav.planning.sensing.belief.Fields`."""

    def sample(self, count: int, key: int, cells: Tensor | None = None) -> Tensor:
        """See `Problem.sample_fields`."""

    def select(self, members: Tensor) -> Self:
        """Keeps some episodes, by index, int64."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """What is to be done.

    Args:
        robot: F with its action bounds and time step.
        objective: J.
        rules: free space, least λ̂, goal radius.
    """

    robot: Robot
    objective: Objective
    rules: Rules = field(default_factory=Rules)


@dataclass(frozen=True, kw_only=True)
class Problem(Batch):
    """A batch of navigation problems on maps of one grid; `pose_problem` makes one.

    Args:
        task: what is to be done.
        observation: what the robots saw.
        distribution: the predicted distribution of λ, shape [B, H, W].
        risk_map: λ̂ as the risk setting gives it, in [0, 1], shape [B, H, W].
        free: S_free, the goal's disc included, bool, shape [B, H, W].
        start: initial states, shape [B, S].
        goal_m: (x, y) of the goals, shape [B, 2].
        time_budget_s: T of each episode, shape [B].
        fields: draws whole fields of λ, whose cells hang together; see `sample_fields`.
        immobile: what immobilises robots in the world, which planners may plan for;
            None for nothing.
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
        """Checks that the batch is one batch."""
        batch = self.start.shape[0]
        expected = {
            "distribution": (batch, *self.grid.shape),
            "risk_map": (batch, *self.grid.shape),
            "free": (batch, *self.grid.shape),
            "goal_m": (batch, 2),
            "time_budget_s": (batch,),
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
        """Shape [B, H, W]."""
        return self.observation.elevation_m

    @property
    def robot(self) -> Robot:
        """F."""
        return self.task.robot

    @property
    def objective(self) -> Objective:
        """J, without the penalty of ground that is not free: see `stage_cost`."""
        return self.task.objective

    @property
    def goal_radius_m(self) -> float:
        """A robot this near has arrived."""
        return self.task.rules.goal_radius_m

    @property
    def dt_s(self) -> float:
        """Time step of the robot."""
        return self.robot.dt_s

    def sample_fields(
        self, count: int, key: int, cells: Tensor | None = None
    ) -> Tensor:
        """Draws fields of λ as what is believed has them, each whole: its cells hang
        together.

        Args:
            count: M.
            key: a stream key, see `benchnav.core.rng`; another key draws other fields.
            cells: which are asked for, bool, shape [B, H, W], which may save time; what
                others hold means nothing then.

        Returns:
            λ in [0, 1], shape [B, M, H, W]; those of an episode do not depend on the
            others.

        Raises:
            ConfigError: nothing was said of how λ hangs together.
        """
        if self.fields is None:
            raise ConfigError(
                "Expected a problem with `fields` to draw from, got None. Pass them "
                "to `pose_problem`."
            )
        return self.fields.sample(count, key, cells).to(self.risk_map)

    def select(self, members: Tensor) -> "Problem":
        """Keeps some episodes, by index, int64."""
        kept = super().select(members)
        return (
            kept
            if self.fields is None
            else replace(kept, fields=self.fields.select(members))
        )

    @cached_property
    def traversability(self) -> Tensor:
        """The λ̂ that motion and path costs are given: at least `min_traversability`,
        shape [B, H, W].

        J is given `risk_map` itself, so that a cost of low λ̂ is not lost.
        """
        return self.risk_map.clamp(min=self.task.rules.min_traversability)

    @cached_property
    def padded_ground(self) -> Tensor:
        """λ̂ and free space in one map framed for lookups: λ̂ where free, −λ̂ where
        not, −0 off the map.

        One lookup a step serves motion, J and the penalty of ground that is not free;
        see `motion_traversability`, `stage_cost` and `free_at`.
        """
        return ground_map(self.grid, self.risk_map, self.free)

    @cached_property
    def action_bounds(self) -> tuple[Tensor, Tensor]:
        """Least and greatest actions, each of shape [A]."""
        return (
            self.start.new_tensor(self.robot.action_low),
            self.start.new_tensor(self.robot.action_high),
        )

    @property
    def dynamics(self) -> "Dynamics":
        """What a rollout goes by besides its maps."""
        return Dynamics(
            self.grid, self.robot, self.objective, self.task.rules.min_traversability
        )

    def ground_at(self, state: Tensor) -> Tensor:
        """Reads `padded_ground` where the robots stand; shape of `state` [B, *K, S]
        without the last.
        """
        return self.grid.lookup(self.padded_ground, state[..., 0], state[..., 1])

    def traversability_at(self, state: Tensor) -> Tensor:
        """λ̂ of motion where the robots stand, 0 off the map; shapes as for
        `ground_at`.
        """
        return motion_traversability(
            self.ground_at(state), self.task.rules.min_traversability
        )

    def free_at(self, state: Tensor) -> Tensor:
        """Tells which robots stand on free ground, bool; shapes as for `ground_at`."""
        return self.ground_at(state) > 0

    def stage_cost(
        self, state: Tensor, action: Tensor, ground: Tensor, target: Tensor
    ) -> Tensor:
        """J of a step, and the penalty of ground that is not free.

        Args:
            state: shape [B, *K, S].
            action: shape [B, *K, A].
            ground: `ground_at(state)`, shape [B, *K].
            target: (x, y) to be reached, shape [B, *1, 2].

        Returns:
            Shape [B, *K].
        """
        return stage_cost(self.objective, state, action, ground, target)

    def terminal_cost(self, state: Tensor, target: Tensor) -> Tensor:
        """J of the last state, and the penalty of ground that is not free; shapes as
        for `stage_cost`.
        """
        return terminal_cost(self.objective, state, self.ground_at(state), target)


class Dynamics(NamedTuple):
    """What a rollout goes by besides its maps, for functions that are compiled.

    Args:
        grid: size and resolution of the maps.
        robot: F.
        objective: J.
        min_traversability: least λ̂ of motion.
    """

    grid: Grid
    robot: Robot
    objective: Objective
    min_traversability: float


def ground_map(grid: Grid, traversability: Tensor, free: Tensor) -> Tensor:
    """`Problem.padded_ground` of any λ and free space, shape [*B, H, W] of both."""
    magnitude = traversability.clamp(min=_ZERO)
    return grid.pad(torch.where(free, magnitude, -magnitude), outside=-0.0)


def motion_traversability(ground: Tensor, min_traversability: float) -> Tensor:
    """λ̂ that motion is given: at least `min_traversability` on the map, 0 off it.

    Args:
        ground: read from `Problem.padded_ground`, any shape.
        min_traversability: of the task's rules.

    Returns:
        Shape of `ground`.
    """
    return torch.where(ground == 0, 0, ground.abs().clamp(min=min_traversability))


def predicted_traversability(ground: Tensor) -> Tensor:
    """λ̂ as the risk setting gives it, 0 off the map, from values of
    `Problem.padded_ground`.
    """
    magnitude = ground.abs()
    return torch.where(magnitude <= _ZERO, 0, magnitude)


def stage_cost(
    objective: Objective, state: Tensor, action: Tensor, ground: Tensor, target: Tensor
) -> Tensor:
    """J of a step and the penalty of ground that is not free; see `Problem.stage_cost`."""
    return objective.stage(
        state, action, predicted_traversability(ground), target
    ) + PENALTY * (ground <= 0)


def terminal_cost(
    objective: Objective, state: Tensor, ground: Tensor, target: Tensor
) -> Tensor:
    """J of the last state and the penalty of ground that is not free; see
    `Problem.terminal_cost`.
    """
    return objective.terminal(
        state, predicted_traversability(ground), target
    ) + PENALTY * (ground <= 0)


@dataclass(frozen=True)
class Prediction:
    """What is predicted of B maps.

    Args:
        observation: what the robots saw.
        distribution: the predicted distribution of λ, shape [B, H, W].
        risk_map: λ̂ as the risk setting gives it, shape [B, H, W].
        free: free terrain, except that at the goal, bool, shape [B, H, W]; None for
            what the rules derive from λ̂.
        fields: draws whole fields of λ; None if no planner asks for them.
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
    """Pose the problem of driving from start to goal, facing the goal.

    Args:
        task: what is to be done.
        prediction: of B maps.
        start_m: (x, y), shape [B, 2].
        goal_m: (x, y), shape [B, 2].
        time_budget_s: T, of all or of each, shape [B].
        immobile: what immobilises robots in the world; None for nothing.
    """
    rules, free = task.rules, prediction.free
    if free is None:
        free = rules.free(prediction.risk_map, prediction.distribution)
    at_goal = cells_at_goal(prediction.observation.grid, goal_m, rules.goal_radius_m)
    return Problem(
        task=task,
        observation=prediction.observation,
        distribution=prediction.distribution,
        risk_map=prediction.risk_map,
        free=free | at_goal,
        start=task.robot.initial_state(heading_to(start_m, goal_m)),
        goal_m=goal_m,
        time_budget_s=torch.as_tensor(
            time_budget_s, dtype=torch.float64, device=goal_m.device
        )
        .expand(len(goal_m))
        .clone(),
        fields=prediction.fields,
        immobile=immobile,
    )


def heading_to(position_m: Tensor, goal_m: Tensor) -> Tensor:
    """Poses (x, y, θ) that look at the goal, shape [B, 3], from positions [B, 2]."""
    offset = goal_m - position_m
    return torch.cat(
        (position_m, torch.atan2(offset[:, 1], offset[:, 0])[:, None]), dim=1
    )
