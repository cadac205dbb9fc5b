"""A global path that provides waypoints to any local planner.

A* returns the cheapest path from the robot's position, and the local planner drives to
a waypoint on this path. If the robot stalls, it is steered along the path instead
(module `recovery`). Source: paper IV-A1, after Fan et al. (2021), "STEP". Letters in
shapes: B episodes, A action dimensions.
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
        explore: multiple of the spread of λ that is added to λ̂ in path costs, ≥ 0; see
            `optimistic`.
    """

    added: ClassVar = ("explore",)

    lookahead_m: float = 4.0
    explore: float = 0.0

    def __post_init__(self) -> None:
        """Validate the settings."""
        check_finite("A*", self, ("lookahead_m",), ("explore",))


@dataclass(frozen=True)
class GuidedState(Batch, Generic[Local]):
    """Plan state of a guided planner.

    Args:
        problem: problems of B episodes, with the λ̂ that path costs use.
        edge_costs: costs of the E edges between neighbouring cells, float64, shape
            [B, E]; see `astar.edge_costs`.
        field: cheapest paths to the goal.
        ground: costs per metre in each cell.
        local: the local planner's plan state.
        recovery: standing times of the robots, and recoveries in progress.
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
        self.config = config
        self.local = local

    @property
    def compiled(self) -> bool | None:
        """Whether the local planner runs compiled; see `Planner`."""
        return self.local.compiled

    def uses(self, task: Task) -> frozenset[str]:
        """Return the inputs that the local planner, free space and path costs need."""
        inputs = self.local.uses(task) | {task.rules.free_space.source}
        if self._cost_uses_map(task):
            inputs |= {"risk_map"}
            if self.config.explore:
                inputs |= {"distribution"}
        return inputs

    @staticmethod
    def _cost_uses_map(task: Task) -> bool:
        """Return whether the objective's cost of a path depends on λ̂."""
        min_traversability = task.rules.min_traversability
        traversability = torch.linspace(min_traversability, 1.0, 9).expand(3, 9)
        grade = torch.tensor([-0.3, 0.0, 0.3])[:, None].expand(3, 9)
        cost = task.objective.path_cost(traversability, grade)
        differs = cost != cost[:, :1]
        return bool(differs.any())

    def follows(self, task: Task) -> str:
        """Return the costs that A* and the local planner minimise instead of J."""
        objective = task.objective
        local_aim = self.local.follows(task)
        name = self.local.name
        is_distance = isinstance(objective, GoalDistance)
        if is_distance or not has_path_cost(objective):
            return f"3D path length (A*), {local_aim or 'J'} ({name})"
        return local_aim and f"J (A*), {local_aim} ({name})"

    def remarks(self, task: Task) -> tuple[str, ...]:
        """Return notes on path costs that do not use J or λ̂; see `Planner`."""
        remarks = []
        objective = task.objective
        if not has_path_cost(objective):
            remarks.append(
                f"A* returns the shortest path, since {type(objective).__name__} has no "
                "`path_cost`"
            )
        if not self._cost_uses_map(task) and task.rules.free_space.by == "mean":
            remarks.append(
                "A* finds the same path under every risk setting, since path costs do "
                "not depend on λ̂, and free cells are derived from the mean; "
                f"the risk setting affects only {self.local.name} (with objective "
                "travel_time, it also affects the path)"
            )
        return tuple(remarks)

    def init(self, problem: Problem, generator: torch.Generator) -> GuidedState[Local]:
        """Return the plan state with the cheapest paths; see `Planner`."""
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
        problem = plan_state.problem
        field = plan_state.field
        state = step.state
        lookahead_m = self.config.lookahead_m
        # The robot, and as many points as can lie within the look-ahead distance.
        count = 2 + int(lookahead_m / problem.grid.resolution_m)
        points = astar.path_points(problem, field, state, count)
        target, straight = choose_waypoint(plan_state.ground, points, lookahead_m)
        aim_m = problem.goal_m if self.local.seeks_goal else target
        action, local, plan = self.local.plan_toward(step, plan_state.local, aim_m)
        was_active = plan_state.recovery.active
        recovery = watch(plan_state.recovery, state, action, problem.robot)
        recovery = aim(recovery, was_active, problem, field, state, straight)
        steered = steer_toward(state, recovery.target_m, problem.robot)
        action = torch.where(recovery.active[:, None], steered, action)
        if step.draw:
            # Longer paths than this, which crosses the map twice, are truncated.
            max_points = 2 * (problem.grid.height + problem.grid.width)
            reference = astar.path_points(problem, field, state, max_points)
            plan = replace(plan, reference=reference)
        local = self.local.commit_action(local, action)
        return action, replace(plan_state, local=local, recovery=recovery), plan

    def revise(
        self, plan_state: GuidedState[Local], problem: Problem
    ) -> GuidedState[Local]:
        """Return the plan state with cheapest paths on the new maps; see `Planner`.

        Maps that have not changed are not searched again.
        """
        local = self.local.revise(plan_state.local, self._local_problem(problem))
        before = plan_state.problem
        costs = plan_state.edge_costs
        field = plan_state.field
        problem = optimistic(problem, self.config.explore)
        changed = problem.traversability != before.traversability
        changed |= problem.free != before.free
        changed |= problem.elevation_m != before.elevation_m
        members = changed.flatten(1).any(1).nonzero()[:, 0]
        if len(members):
            costs = astar.revised_edge_costs(problem, costs, changed)
            member_costs = (costs[member] for member in members.tolist())
            searched = astar.search(problem.select(members), member_costs)
            field = field.put(members, searched)
        return replace(
            plan_state,
            problem=problem,
            edge_costs=costs,
            field=field,
            ground=ground_costs(problem),
            local=local,
        )

    def select(
        self, plan_state: GuidedState[Local], members: Tensor
    ) -> GuidedState[Local]:
        """Return the plan state of some episodes; see `Planner`."""
        # The local plan state is selected by the local planner, since only that planner
        # knows which of its tensors have an episode dimension.
        shared: GuidedState[Any] = replace(plan_state, local=None)  # type: ignore[arg-type]
        local = self.local.select(plan_state.local, members)
        return replace(shared.select(members), local=local)

    def _local_problem(self, problem: Problem) -> Problem:
        """Return the local planner's problem, with J to the goal or to waypoints."""
        if self.local.seeks_goal:
            return problem
        objective = toward_waypoints(problem.objective)
        task = replace(problem.task, objective=objective)
        return replace(problem, task=task)


def optimistic(problem: Problem, explore: float) -> Problem:
    """Return the problem with λ̂ raised, up to 1, by a multiple of the spread of λ.

    Paths through uncertain terrain then become cheaper, at any distance from the robot.
    The robot observes such terrain before it drives there, and can still turn away. If
    the belief learns, sensed terrain and terrain that is correlated with it have only a
    small spread. If the belief does not learn, the spread stays the same during the
    episode, and the bonus only favours risk. The free mask does not change.

    Args:
        problem: B problems.
        explore: multiple of the spread; 0 returns the problem itself.
    """
    if explore == 0:
        return problem
    bonus = explore * problem.distribution.spread().to(problem.risk_map)
    return replace(problem, risk_map=(problem.risk_map + bonus).clamp(max=1))
