"""A planner that compares the time to the goal along rays."""

import math

import torch

from benchnav.planning import Plan, Planner, Problem, Step


class Rays(Planner[Problem]):
    """Planner that turns to the ray with the shortest estimated time to the goal.

    Args:
        rays: number of directions.
        length_m: length of a ray in metres.
    """

    steers = (("speed_mps", "turn_rate_radps"),)

    def __init__(self, rays: int = 36, length_m: float = 4.0) -> None:
        self.rays, self.length_m = rays, length_m

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        """Return the plan state, which is passed from step to step."""
        return problem

    def plan(
        self, step: Step, plan_state: Problem
    ) -> tuple[torch.Tensor, Problem, Plan]:
        """Return the actions [B, 2] (speed, turn rate), the plan state and the plan."""
        problem, position, heading = plan_state, step.state[:, :2], step.state[:, 2]
        to_goal = problem.goal_m - position
        turns = torch.arange(self.rays, device=position.device) * (
            2 * math.pi / self.rays
        )
        angles = torch.atan2(to_goal[:, 1], to_goal[:, 0])[:, None] + turns  # [B, R]
        # no further than the goal
        length = to_goal.norm(dim=1).clamp(max=self.length_m)[:, None]
        fractions = torch.linspace(0.1, 1, 10, device=position.device)
        # [B, R, 2]
        along = torch.stack((angles.cos(), angles.sin()), dim=-1) * length[..., None]
        # [B, R, N, 2]
        points = position[:, None, None] + fractions[:, None] * along[:, :, None]
        pose = torch.cat(
            (points, angles[:, :, None, None].expand(*points.shape[:3], 1)), dim=-1
        )
        # off the map λ̂ is 0
        pace = 1 / problem.traversability_at(pose).clamp(min=1e-3)
        pace = torch.where(problem.free_at(pose), pace, 1e3)
        remaining = (problem.goal_m[:, None] - points[:, :, -1]).norm(dim=-1)
        best = (length * pace.mean(dim=-1) + remaining).argmin(
            dim=1, keepdim=True
        )  # [B, 1]
        turn = angles.gather(1, best).squeeze(1) - heading
        turn = torch.atan2(turn.sin(), turn.cos())
        low, high = problem.action_bounds
        action = torch.stack(
            (high[0] * turn.cos().clamp(min=0), turn / problem.dt_s), dim=1
        )
        drawn = {"samples": points} if step.draw else {}
        return (
            action.clamp(low, high),
            plan_state,
            Plan.empty(len(problem), position.device, **drawn),
        )
