"""A global path that provides waypoints to any local planner.

A* returns the cheapest path from the robot's position; the local planner heads for a
waypoint on it. A robot that its local planner keeps at one position is steered along
the path. Source: paper IV-A1, after Fan et al. (2021), "STEP". Letters in shapes: B
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
        lookahead_m: maximum distance along the path to the waypoint, in metres.
        explore: optimism about terrain that the robot may observe before it is on it;
            see `optimistic`.
    """

    added: ClassVar = ("explore",)

    lookahead_m: float = 4.0
    explore: float = 0.0

    def __post_init__(self) -> None:
        """Validate the look-ahead and the optimism."""
        check_finite("A*", self, ("lookahead_m",), ("explore",))


@dataclass(frozen=True)
class GuidedState(Batch, Generic[Local]):
    """Plan state of a guided planner.

    Args:
        problem: the problem, with the λ̂ that path costs use.
        edge_costs: costs of moving between neighbouring cells, float64, shape [B, E];
            see `astar.edge_costs`.
        field: cheapest paths to the goal.
        ground: costs of a metre in each cell.
        local: the local planner's plan state.
        recovery: recovery of robots that stand.
    """

    problem: Problem
    edge_costs: Tensor
    field: astar.CostToGo
    ground: GroundCosts
    local: Local
    recovery: Recovery


class Guided(Planner[GuidedState[Local]], Generic[Local]):
    """A planner that consists of A* and a local planner.

    Args:
        config: settings of the global path.
        local: planner that drives to waypoints.
    """

    def __init__(self, config: GuideConfig, local: LocalPlanner[Local]) -> None:
        """Store the settings."""
        self.config, self.local = config, local

    @property
    def compiled(self) -> bool | None:
        """Whether the local planner runs compiled; see `Planner`."""
        return self.local.compiled

    def uses(self, task: Task) -> frozenset[str]:
        """Return the inputs of the local planner, of free space and of path costs.

        See `Planner`.
        """
        path = set()
        if self._cost_uses_map(task):
            path = {"risk_map", "distribution"} if self.config.explore else {"risk_map"}
        return self.local.uses(task) | {task.rules.free_space.source} | path

    @staticmethod
    def _cost_uses_map(task: Task) -> bool:
        """Return whether the cost of a path depends on λ̂, on level terrain or slopes."""
        lowest = task.rules.min_traversability
        traversability = torch.linspace(lowest, 1.0, 9).expand(3, 9)
        grade = torch.tensor([-0.3, 0.0, 0.3])[:, None].expand(3, 9)
        cost = task.objective.path_cost(traversability, grade)
        return bool((cost != cost[:, :1]).any())

    def follows(self, task: Task) -> str:
        """Return what A* and the local planner minimise instead of J; see `Planner`."""
        local_aim = self.local.follows(task)
        if isinstance(task.objective, GoalDistance) or not has_path_cost(
            task.objective
        ):
            return f"3D path length (A*), {local_aim or 'J'} ({self.local.name})"
        return local_aim and f"J (A*), {local_aim} ({self.local.name})"

    def remarks(self, task: Task) -> tuple[str, ...]:
        """Return notes on path costs that do not use J or λ̂; see `Planner`."""
        remarks, objective = [], task.objective
        if not has_path_cost(objective):
            remarks.append(
                f"A* takes the shortest path: {type(objective).__name__} has no "
                "`path_cost`"
            )
        if not self._cost_uses_map(task) and task.rules.free_space.by == "mean":
            remarks.append(
                "A* finds the same path under every risk setting, since its cost does "
                "not use λ̂ and free ground is "
                f"set by the mean; risk moves {self.local.name} alone (objective "
                "travel_time moves the path)"
            )
        return tuple(remarks)

    def init(self, problem: Problem, generator: torch.Generator) -> GuidedState[Local]:
        """Return the plan state after a search of the maps; see `Planner`."""
        local = self.local.init(self._local_problem(problem), generator)
        recovery = Recovery.none(problem.start)
        problem = optimistic(problem, self.config.explore)
        costs = astar.edge_costs(problem)
        field = astar.search(problem, costs)
        ground = ground_costs(problem)
        return GuidedState(problem, costs, field, ground, local, recovery)

    def plan(
        self, step: Step, plan_state: GuidedState[Local]
    ) -> tuple[Tensor, GuidedState[Local], Plan]:
        """Return actions along the cheapest path; see `Planner`."""
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
        steered = steer_toward(state, recovery.target_m, problem.robot)
        action = torch.where(recovery.active[:, None], steered, action)
        if step.draw:
            # Long enough for a path that crosses the map twice; longer ones are cut.
            max_points = 2 * (problem.grid.height + problem.grid.width)
            plan = replace(
                plan, reference=astar.path_points(problem, field, state, max_points)
            )
        local = self.local.commit_action(local, action)
        return action, replace(plan_state, local=local, recovery=recovery), plan

    def revise(
        self, plan_state: GuidedState[Local], problem: Problem
    ) -> GuidedState[Local]:
        """Return the plan state after a search of changed maps; see `Planner`.

        The local planner's motion is kept.
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
            searched = astar.search(
                problem.select(members), (costs[member] for member in members.tolist())
            )
            field = field.put(members, searched)
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
        """Return the plan state of some episodes; see `Planner`."""
        # Only the local planner knows which of its tensors have an episode dimension.
        shared: GuidedState[Any] = replace(plan_state, local=None)  # type: ignore[arg-type]
        return replace(
            shared.select(members), local=self.local.select(plan_state.local, members)
        )

    def _local_problem(self, problem: Problem) -> Problem:
        """Return the local planner's problem: J to the goal, or to the next waypoint."""
        if self.local.seeks_goal:
            return problem
        objective = toward_waypoints(problem.objective)
        return replace(problem, task=replace(problem.task, objective=objective))


def optimistic(problem: Problem, explore: float) -> Problem:
    """Return the problem with λ̂ raised, to 1 at most, by a multiple of its spread.

    A path through uncertain terrain is then worth trying, since the robot observes that
    terrain before it is on it, and can still turn away. No distance limits the bonus.
    Under a belief that learns, terrain that is sensed early, or correlated with such
    terrain, has hardly any spread left. Under one that does not learn, nothing is
    settled during the episode, and the bonus only favours risk. The free mask does not
    change.

    Args:
        problem: B problems.
        explore: multiple of the spread; 0 returns the problem itself.
    """
    if explore == 0:
        return problem
    bonus = explore * problem.distribution.spread().to(problem.risk_map)
    return replace(problem, risk_map=(problem.risk_map + bonus).clamp(max=1))
