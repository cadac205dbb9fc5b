"""A global path that gives way-points to any local planner, and the recovery of a robot that stands.

A* gives the cheapest path from wherever the robot stands; the local planner heads for a way-point on it.
Where a local planner has held a robot in place for a second, the robot is steered along the path, cell by
cell, until it has left the place; one that drives and is held by the ground is left to its planner.
Source: paper IV-A1, after Fan et al. (2021), "STEP"; the recovery is ours. Letters in shapes: B episodes,
S state and A action dimensions.
"""

from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.planning.objective import distance
from benchnav.planning.planners import astar
from benchnav.planning.planners.planner import Plan, Step
from benchnav.planning.planners.straight import steer_toward
from benchnav.planning.planners.waypoint import GroundCosts, choose_waypoint, ground_costs
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Robot

# A robot that has moved less than this
_STANDING_M = 0.05
# for so long,
_PATIENCE_S = 1.0
# at less than this share of its top speed as commanded, is steered along the path,
_IDLE = 0.2
# from one of its points to within this share of a cell's width of the next,
_REACHED = 0.1
# until it is this far away
_LEFT_M = 0.5
# or so much time has passed.
_RECOVERY_S = 20.0

Local = TypeVar("Local")


class LocalPlanner(Protocol[Local]):
    """The contract of a local planner: a planner that is told where to go at each step."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    def init(self, problem: Problem, generator: torch.Generator) -> Local:
        """Prepares to plan; see `Planner`."""
        ...

    def plan_toward(self, step: Step, plan_state: Local, target_m: Tensor) -> tuple[Tensor, Local, Plan]:
        """Chooses actions toward a target (x, y), shape [B, 2]; else as `Planner.plan`."""
        ...

    def took(self, plan_state: Local, action: Tensor) -> Local:
        """Notes the actions that are taken, which may be others than it chose, shape [B, A]."""
        ...


@dataclass(frozen=True, kw_only=True)
class GuideConfig:
    """Settings of the global path.

    Args:
        lookahead_m: how far along the path the way-point lies at most.
        by_time: A* minimises time under λ̂ rather than 3D length.
    """

    lookahead_m: float = 4.0
    by_time: bool = False

    def __post_init__(self) -> None:
        """Refuses a look-ahead that looks nowhere."""
        if not 0 < self.lookahead_m < float("inf"):
            raise ConfigError(f"Expected `lookahead_m` > 0 and finite for A*, got {self.lookahead_m}.")


@dataclass(frozen=True)
class Recovery:
    """How long each robot has stood, and whether it is being steered away.

    Args:
        place_m: (x, y) that it has not left, shape [B, 2].
        steps: steps that it has been there, int64, shape [B].
        driven_m: how far it was to drive in these, shape [B].
        active: it is being steered away, bool, shape [B].
        target_m: (x, y) that it is then steered to, shape [B, 2].
        cell: flat index of the path's cell at or behind that, int64, shape [B].
    """

    place_m: Tensor
    steps: Tensor
    driven_m: Tensor
    active: Tensor
    target_m: Tensor
    cell: Tensor

    @classmethod
    def none(cls, state: Tensor) -> "Recovery":
        """That of robots, shape [B, S], which have not been anywhere yet."""
        zero = torch.zeros_like(state[:, 0])
        place = torch.full_like(state[:, :2], torch.inf)
        return cls(place, zero.long(), zero, zero.bool(), place, zero.long())


def watch(recovery: Recovery, state: Tensor, action: Tensor, robot: Robot) -> Recovery:
    """Begins and ends recoveries.

    Args:
        recovery: up to the last step.
        state: where the robots are now, shape [B, S].
        action: what the local planner would do next, the speed first, shape [B, A].
        robot: for its time step and top speed.
    """
    left = distance(state, recovery.place_m) >= torch.where(recovery.active, _LEFT_M, _STANDING_M)
    time_s = (recovery.steps + 1) * robot.dt_s
    given_up = recovery.active & (time_s >= _PATIENCE_S + _RECOVERY_S)
    anew = left | given_up
    held = (time_s >= _PATIENCE_S) & (recovery.driven_m < _IDLE * robot.top_speed_mps * time_s)
    return replace(
        recovery,
        place_m=torch.where(anew[:, None], state[:, :2], recovery.place_m),
        steps=torch.where(anew, 0, recovery.steps + 1),
        driven_m=torch.where(anew, 0, recovery.driven_m) + action[:, 0].abs() * robot.dt_s,
        active=~anew & (recovery.active | held),
    )


def aim(
    recovery: Recovery,
    begun: Tensor,
    problem: Problem,
    field: astar.CostToGo,
    state: Tensor,
    straight: Tensor,
) -> Recovery:
    """Says where robots are steered: along the path, from the centre of one cell to that of the next.

    Where dearer ground lies on the line to the next cell, it is reached by way of the corner that the two
    cells share, which no other cell has a part in. A robot keeps to a target until it is there.

    Args:
        recovery: now, from `watch`, with the targets of the last step.
        begun: those whose recovery began earlier, bool, shape [B].
        problem: B problems.
        field: cheapest paths to the goal.
        state: where the robots are now, shape [B, S].
        straight: no dearer ground lies on the line to the next cell, bool, shape [B].

    Returns:
        The recovery with the targets of this step.
    """
    grid = problem.grid

    def after(cell: Tensor) -> Tensor:
        return field.following.gather(1, cell[:, None])[:, 0]

    def centre(cell: Tensor) -> Tensor:
        return torch.stack(grid.centre_of(cell // grid.width, cell % grid.width), dim=-1).to(state)

    def point(cell: Tensor) -> Tensor:
        return torch.where((after(cell) == cell)[:, None], problem.goal_m, centre(cell))

    arrived = distance(state, recovery.target_m) < _REACHED * grid.resolution_m
    at_point = (recovery.target_m == point(recovery.cell)).all(dim=1)
    cell = torch.where(arrived & at_point, after(recovery.cell), recovery.cell)
    target = torch.where(arrived[:, None], point(cell), recovery.target_m)

    row, column = grid.cell_of(state[:, 0], state[:, 1])
    own = row * grid.width + column
    first = after(own)
    gate = 0.5 * (centre(own) + centre(first))
    first_m = torch.where(straight[:, None], point(first), gate)
    return replace(
        recovery,
        target_m=torch.where(begun[:, None], target, first_m),
        cell=torch.where(begun, cell, first),
    )


@dataclass(frozen=True)
class GuidedState(Generic[Local]):
    """What a guided planner carries from step to step.

    Args:
        problem: what is being solved.
        field: cheapest paths to the goal.
        ground: what a metre costs in each cell.
        local: the local planner's plan state.
        recovery: of robots that stand.
    """

    problem: Problem
    field: astar.CostToGo
    ground: GroundCosts
    local: Local
    recovery: Recovery


class Guided(Generic[Local]):
    """A local planner guided by A*, as a planner.

    Args:
        guide: settings of the global path.
        local: drives to way-points.
    """

    def __init__(self, guide: GuideConfig, local: LocalPlanner[Local]) -> None:
        """Keeps the settings; all else is in the plan state."""
        self.guide, self.local = guide, local

    @property
    def follows(self) -> str:
        """Whose objectives it follows."""
        cost = "travel time" if self.guide.by_time else "path length"
        return f"{cost} (A*), J ({self.local.name})"

    def init(self, problem: Problem, generator: torch.Generator) -> GuidedState[Local]:
        """Searches the maps; see `Planner`."""
        by_time = self.guide.by_time
        return GuidedState(
            problem=problem,
            field=astar.search(problem, by_time),
            ground=ground_costs(problem, by_time),
            local=self.local.init(problem, generator),
            recovery=Recovery.none(problem.start),
        )

    def plan(self, step: Step, plan_state: GuidedState[Local]) -> tuple[Tensor, GuidedState[Local], Plan]:
        """Follows the cheapest path; see `Planner`."""
        problem, field, state = plan_state.problem, plan_state.field, step.state
        count = 2 + int(self.guide.lookahead_m / problem.grid.resolution_m)
        points = astar.path_points(problem, field, state, count)
        target, straight = choose_waypoint(plan_state.ground, points, self.guide.lookahead_m)
        action, local, plan = self.local.plan_toward(step, plan_state.local, target)
        recovery = watch(plan_state.recovery, state, action, problem.robot)
        recovery = aim(recovery, plan_state.recovery.active, problem, field, state, straight)
        away = steer_toward(state, recovery.target_m, problem.robot)
        action = torch.where(recovery.active[:, None], away, action)
        if step.draw:
            # Long enough for a path that crosses the map twice; longer ones are cut.
            whole = 2 * (problem.grid.height + problem.grid.width)
            plan = replace(plan, reference=astar.path_points(problem, field, state, whole))
        local = self.local.took(local, action)
        return action, replace(plan_state, local=local, recovery=recovery), plan
