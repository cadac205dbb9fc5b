"""A\\*+DWA and CL-RRT, each without one of its parts: what the part is worth, by the suite `without.yaml`."""

from dataclasses import replace
from typing import Any

import torch

from benchnav.planning import CLRRT, AStarDWA
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.astar.recovery import aim, watch
from benchnav.planning.planners.straight import steer_toward


class NoLines(AStarDWA):
    """A\\*+DWA that heads for the farthest point of the path within the look-ahead, whatever lies between."""

    def plan(self, step: Any, plan_state: Any) -> Any:
        problem, field, state = plan_state.problem, plan_state.field, step.state
        count = 2 + int(self.config.lookahead_m / problem.grid.resolution_m)
        points = astar.path_points(problem, field, state, count)
        along_m = torch.linalg.vector_norm(points.diff(dim=1), dim=2).cumsum(dim=1)
        farthest = torch.where(along_m <= self.config.lookahead_m, torch.arange(count - 1), 0).amax(dim=1)
        target = points[:, 1:].gather(1, farthest[:, None, None].expand(-1, 1, 2))[:, 0]
        action, local, plan = self.local.plan_toward(step, plan_state.local, target)
        recovery = watch(plan_state.recovery, state, action, problem.robot)
        everywhere = torch.ones(len(state), dtype=torch.bool)
        recovery = aim(recovery, plan_state.recovery.active, problem, field, state, everywhere)
        away = steer_toward(state, recovery.target_m, problem.robot)
        action = torch.where(recovery.active[:, None], away, action)
        local = self.local.commit_action(local, action)
        return action, replace(plan_state, local=local, recovery=recovery), plan


class NoHalving(CLRRT):
    """CL-RRT whose turning radius stays what it is after a failure."""

    def _closed_loop(self, *given: Any) -> Any:
        loop = super()._closed_loop(*given)
        return replace(loop, radius_m=torch.full_like(loop.radius_m, self.config.turning_radius_m))
