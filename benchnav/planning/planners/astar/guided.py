"""A global path that gives way-points to any local planner.

A* gives the cheapest path from wherever the robot stands; the local planner heads for a
way-point on it. A robot that its local planner holds in place is steered along the
path. Source: paper IV-A1, after Fan et al. (2021), "STEP". Letters in shapes: B
episodes, A action dimensions.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.planning.objective import GoalDistance, has_path_cost, toward_waypoints
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.astar.recovery import Recovery, aim, watch
from benchnav.planning.planners.astar.waypoint import (
    GroundCosts,
    choose_waypoint,
    ground_costs,
)
from benchnav.planning.planners.planner import LocalPlanner, Plan, Planner, check_finite
from benchnav.planning.planners.straight import steer_toward
from benchnav.planning.problem import Problem, Task
from benchnav.planning.sensing.sensor import Step

Local = TypeVar("Local")


@dataclass(frozen=True, kw_only=True)
class GuideConfig:
    """Settings of the global path.

    Args:
        lookahead_m: how far along the path the way-point lies at most.
        explore: optimism about ground that the robot would get to know on its way; see
            `optimistic`.
    """

    added: ClassVar = ("explore",)

    lookahead_m: float = 4.0
    explore: float = 0.0

    def __post_init__(self) -> None:
        """Refuses a look-ahead that looks nowhere, and pessimism."""
        check_finite("A*", self, ("lookahead_m",), ("explore",))


@dataclass(frozen=True)
class GuidedState(Batch, Generic[Local]):
    """What a guided planner carries from step to step.

    Args:
        problem: what is being solved, with the λ̂ that path costs are given.
        edge_costs: of moving between neighbouring cells, float64, shape [B, E]; see
            `astar.edge_costs`.
        field: cheapest paths to the goal.
        ground: what a metre costs in each cell.
        local: the local planner's plan state.
        recovery: of robots that stand.
    """

    problem: Problem
    edge_costs: Tensor
    field: astar.CostToGo
    ground: GroundCosts
    local: Local
    recovery: Recovery


class Guided(Planner[GuidedState[Local]], Generic[Local]):
    """A local planner guided by A*, as a planner.

    Args:
        config: settings of the global path.
        local: drives to way-points.
    """

    def __init__(self, config: GuideConfig, local: LocalPlanner[Local]) -> None:
        """Keeps the settings; all else is in the plan state."""
        self.config, self.local = config, local

    @property
    def compiled(self) -> bool | None:
        """Whether the local planner runs compiled; see `Planner`."""
        return self.local.compiled

    def uses(self, task: Task) -> frozenset[str]:
        """What the local planner uses, free space, and λ̂ where a path's cost does; see
        `Planner`.
        """
        path = set()
        if self._cost_uses_map(task):
            path = {"risk_map", "distribution"} if self.config.explore else {"risk_map"}
        return self.local.uses(task) | {task.rules.free_space.source} | path

    @staticmethod
    def _cost_uses_map(task: Task) -> bool:
        """Whether the cost of a metre of path changes with λ̂, on level ground or on a
        slope.
        """
        traversability = torch.linspace(task.rules.min_traversability, 1.0, 9).expand(
            3, 9
        )
        grade = torch.tensor([-0.3, 0.0, 0.3])[:, None].expand(3, 9)
        cost = task.objective.path_cost(traversability, grade)
        return bool((cost != cost[:, :1]).any())

    def follows(self, task: Task) -> str:
        """What A* and the local planner minimise where that is not J alone; see
        `Planner`.
        """
        own = self.local.follows(task)
        if isinstance(task.objective, GoalDistance) or not has_path_cost(
            task.objective
        ):
            return f"3D path length (A*), {own or 'J'} ({self.local.name})"
        return own and f"J (A*), {own} ({self.local.name})"

    def remarks(self, task: Task) -> tuple[str, ...]:
        """Says what a path costs where J does not, and where no risk setting moves the
        path; see `Planner`.
        """
        found, objective = [], task.objective
        if not has_path_cost(objective):
            found.append(
                f"A* takes the shortest path: {type(objective).__name__} has no "
                "`path_cost`"
            )
        if not self._cost_uses_map(task) and task.rules.free_space.by == "mean":
            found.append(
                "A* finds the same path under every risk setting, since its cost does "
                "not use λ̂ and free ground is "
                f"set by the mean; risk moves {self.local.name} alone (objective "
                "travel_time moves the path)"
            )
        return tuple(found)

    def init(self, problem: Problem, generator: torch.Generator) -> GuidedState[Local]:
        """Searches the maps; see `Planner`."""
        local = self.local.init(self._local_problem(problem), generator)
        recovery, problem = (
            Recovery.none(problem.start),
            optimistic(problem, self.config.explore),
        )
        costs = astar.edge_costs(problem)
        return GuidedState(
            problem,
            costs,
            astar.search(problem, costs),
            ground_costs(problem),
            local,
            recovery,
        )

    def plan(
        self, step: Step, plan_state: GuidedState[Local]
    ) -> tuple[Tensor, GuidedState[Local], Plan]:
        """Follows the cheapest path; see `Planner`."""
        problem, field, state = plan_state.problem, plan_state.field, step.state
        # The robot, and as many points as can lie within the look-ahead.
        count = 2 + int(self.config.lookahead_m / problem.grid.resolution_m)
        points = astar.path_points(problem, field, state, count)
        target, straight = choose_waypoint(
            plan_state.ground, points, self.config.lookahead_m
        )
        aim_m = problem.goal_m if self.local.seeks_goal else target
        action, local, plan = self.local.plan_toward(step, plan_state.local, aim_m)
        recovery = watch(plan_state.recovery, state, action, problem.robot)
        recovery = aim(
            recovery, plan_state.recovery.active, problem, field, state, straight
        )
        away = steer_toward(state, recovery.target_m, problem.robot)
        action = torch.where(recovery.active[:, None], away, action)
        if step.draw:
            # Long enough for a path that crosses the map twice; longer ones are cut.
            whole = 2 * (problem.grid.height + problem.grid.width)
            plan = replace(
                plan, reference=astar.path_points(problem, field, state, whole)
            )
        local = self.local.commit_action(local, action)
        return action, replace(plan_state, local=local, recovery=recovery), plan

    def revise(
        self, plan_state: GuidedState[Local], problem: Problem
    ) -> GuidedState[Local]:
        """Searches the maps again whose ground has changed, and keeps the local
        planner's motion; see `Planner`.
        """
        local = self.local.revise(plan_state.local, self._local_problem(problem))
        before, costs, field = (
            plan_state.problem,
            plan_state.edge_costs,
            plan_state.field,
        )
        problem = optimistic(problem, self.config.explore)
        changed = (problem.traversability != before.traversability) | (
            problem.free != before.free
        )
        changed |= problem.elevation_m != before.elevation_m
        members = changed.flatten(1).any(1).nonzero()[:, 0]
        if len(members):
            costs = astar.revised_edge_costs(problem, costs, changed)
            found = astar.search(
                problem.select(members), (costs[own] for own in members.tolist())
            )
            field = field.put(members, found)
        ground = ground_costs(problem)
        return replace(
            plan_state,
            problem=problem,
            edge_costs=costs,
            field=field,
            ground=ground,
            local=local,
        )

    def select(
        self, plan_state: GuidedState[Local], members: Tensor
    ) -> GuidedState[Local]:
        """Keeps some episodes; see `Planner`."""
        # The local planner alone knows which of its tensors are of episodes.
        shared: GuidedState[Any] = replace(plan_state, local=None)  # type: ignore[arg-type]
        return replace(
            shared.select(members), local=self.local.select(plan_state.local, members)
        )

    def _local_problem(self, problem: Problem) -> Problem:
        """The local planner's problem: J to the goal where it seeks that, else J from
        waypoint to waypoint.
        """
        if self.local.seeks_goal:
            return problem
        return replace(
            problem,
            task=replace(problem.task, objective=toward_waypoints(problem.objective)),
        )


def optimistic(problem: Problem, explore: float) -> Problem:
    """The problem whose λ̂ is raised, to 1 at most, by so many times the spread of what
    is believed of each cell.

    A path through ground that may be good is then worth a try, since the robot gets to
    know that ground before it is on it, and can still turn away. No distance says which
    ground that is: what a robot senses before it commits itself has hardly any spread
    left by then, and neither has what lies within the correlation of that, under a
    belief that learns. Under one that does not, nothing is settled on the way, and the
    bonus is a mere taste for risk. Free ground stays what it is.

    Args:
        problem: B problems.
        explore: how many times; 0 gives the problem itself.
    """
    if explore == 0:
        return problem
    bonus = explore * problem.distribution.spread().to(problem.risk_map)
    return replace(problem, risk_map=(problem.risk_map + bonus).clamp(max=1))
