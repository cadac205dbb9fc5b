"""A* + DWA: a global path over the map's cells, followed by a local planner.

A* gives the shortest path from wherever the robot stands; DWA heads for the farthest point of it
within the look-ahead that lies in a free straight line. Source: paper IV-A1, after Fan et al. (2021),
"STEP". Letters in shapes: B episodes, N points, M velocity pairs, T horizon steps.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.planning import astar
from benchnav.planning.dwa import DWAConfig, choose_velocity
from benchnav.planning.planner import Plan, PlanStatus
from benchnav.planning.problem import Problem

_LINE_POINTS = 16
_DRAW_EVERY = 5


@dataclass(frozen=True, kw_only=True)
class AStarDWAConfig(DWAConfig):
    """Settings of A* + DWA: those of DWA, and these.

    Args:
        lookahead_m: how far along the path the waypoint lies at most.
        by_time: A* minimises time under λ̂ rather than 3D length.
    """

    lookahead_m: float = 4.0
    by_time: bool = False

    def __post_init__(self) -> None:
        """Refuses a look-ahead that looks nowhere."""
        super().__post_init__()
        if not self.lookahead_m > 0:
            raise ConfigError(f"Expected `lookahead_m` > 0 for A* + DWA, got {self.lookahead_m}.")


@dataclass(frozen=True)
class AStarDWAState:
    """What A* + DWA carries from step to step.

    Args:
        problem: what is being solved.
        field: shortest paths to the goal.
        velocity: last commanded (v, ω), shape [B, 2].
    """

    problem: Problem
    field: astar.CostToGo
    velocity: Tensor


class AStarDWA:
    """A* + DWA as a planner.

    Args:
        config: settings.
    """

    def __init__(self, config: AStarDWAConfig | None = None) -> None:
        """Keeps the settings; all else is in the plan state."""
        self.config = config or AStarDWAConfig()

    def init(self, problem: Problem, generator: torch.Generator) -> AStarDWAState:
        """Searches the maps; draws nothing. See `Planner`.

        Raises:
            ConfigError: the robot's actions are not (v, ω).
        """
        if len(problem.dynamics.action_low) != 2:
            raise ConfigError(
                f"Expected dynamics with actions (v, ω) for A* + DWA, got {len(problem.dynamics.action_low)} actions."
            )
        standing = problem.start.new_zeros(len(problem), 2)
        return AStarDWAState(problem, astar.search(problem, self.config.by_time), standing)

    def plan(self, state: Tensor, plan_state: AStarDWAState) -> tuple[Tensor, AStarDWAState, Plan]:
        """Follows the shortest path; see `Planner`. Where there is none the status is FAILED."""
        problem, field = plan_state.problem, plan_state.field
        reference = self._reference(problem, field, state)
        waypoint = self._waypoint(problem, state, reference)
        velocity, trajectories, best = choose_velocity(
            problem, state, plan_state.velocity, waypoint, self.config
        )
        row, column = problem.grid.cell_of(state[:, 0], state[:, 1])
        cost = field.cost.flatten(1).gather(1, (row * problem.grid.width + column)[:, None])[:, 0]
        plan = Plan.empty(
            len(problem),
            state.device,
            status=torch.where(cost.isfinite(), PlanStatus.OK, PlanStatus.FAILED),
            path=trajectories[torch.arange(len(best), device=best.device), best],
            samples=trajectories[:, :, ::_DRAW_EVERY],
            reference=reference,
        )
        return velocity, replace(plan_state, velocity=velocity), plan

    def _reference(self, problem: Problem, field: astar.CostToGo, state: Tensor) -> Tensor:
        """Points of the path: the robot, the centres of cells, the goal; shape [B, N, 2]."""
        grid = problem.grid
        row, column = grid.cell_of(state[:, 0], state[:, 1])
        # Long enough for a path that crosses the map twice; longer ones are cut, and seen on the way.
        cells = astar.path_cells(field, row * grid.width + column, 2 * (grid.height + grid.width))
        points = torch.stack(grid.centre_of(cells // grid.width, cells % grid.width), dim=-1)
        ended = field.following.gather(1, cells) == cells
        points = torch.where(ended[..., None], problem.goal_m[:, None], points.to(state.dtype))
        return torch.cat((state[:, None, :2], points[:, 1:]), dim=1)

    def _waypoint(self, problem: Problem, state: Tensor, reference: Tensor) -> Tensor:
        """The farthest point within the look-ahead in a free straight line, else the next; [B, 2]."""
        count = 2 + int(self.config.lookahead_m / problem.grid.resolution_m)
        ahead = reference[:, 1:count]
        steps = torch.linalg.vector_norm(reference[:, 1:count] - reference[:, : count - 1], dim=2)
        near = steps.cumsum(dim=1) <= self.config.lookahead_m
        share = torch.linspace(0, 1, _LINE_POINTS, device=state.device, dtype=state.dtype)[:, None]
        line = state[:, None, None, :2] + share * (ahead[:, :, None] - state[:, None, None, :2])
        here = problem.traversability_at(state) > problem.stuck_threshold
        free = problem.traversability_at(line) > problem.stuck_threshold
        # From a cell that is not free no line is free; then the next point is the way out.
        seen = free.all(dim=2) & near & here[:, None]
        rank = torch.arange(1, ahead.shape[1] + 1, device=state.device)
        farthest = (seen * rank).amax(dim=1).sub(1).clamp(min=0)
        return ahead.gather(1, farthest[:, None, None].expand(-1, 1, 2))[:, 0]
