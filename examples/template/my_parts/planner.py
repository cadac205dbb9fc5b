"""A planner that looks along rays."""

import math

import torch

from benchnav.planning import Plan, Planner, Problem, Step


class Rays(Planner[Problem]):
    """Turns to the ray along which the way to the goal costs least time, by λ̂.

    Args:
        rays: how many directions it looks in.
        length_m: how far it looks.
    """

    steers = (("speed_mps", "turn_rate_radps"),)

    def __init__(self, rays: int = 36, length_m: float = 4.0) -> None:
        self.rays, self.length_m = rays, length_m

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        """The plan state: all that is kept from step to step."""
        return problem

    def plan(
        self, step: Step, plan_state: Problem
    ) -> tuple[torch.Tensor, Problem, Plan]:
        """Actions of shape [B, 2]: speed and turn rate."""
        problem, here, heading = plan_state, step.state[:, :2], step.state[:, 2]
        to_goal = problem.goal_m - here
        turns = torch.arange(self.rays, device=here.device) * (2 * math.pi / self.rays)
        angles = torch.atan2(to_goal[:, 1], to_goal[:, 0])[:, None] + turns  # [B, R]
        # no further than the goal
        far = to_goal.norm(dim=1).clamp(max=self.length_m)[:, None]
        shares = torch.linspace(0.1, 1, 10, device=here.device)
        # [B, R, 2]
        along = torch.stack((angles.cos(), angles.sin()), dim=-1) * far[..., None]
        # [B, R, N, 2]
        points = here[:, None, None] + shares[:, None] * along[:, :, None]
        pose = torch.cat(
            (points, angles[:, :, None, None].expand(*points.shape[:3], 1)), dim=-1
        )
        # off the map λ̂ is 0
        pace = 1 / problem.traversability_at(pose).clamp(min=1e-3)
        pace = torch.where(problem.free_at(pose), pace, 1e3)
        left = (problem.goal_m[:, None] - points[:, :, -1]).norm(dim=-1)
        best = (far * pace.mean(dim=-1) + left).argmin(dim=1, keepdim=True)  # [B, 1]
        off = angles.gather(1, best).squeeze(1) - heading
        off = torch.atan2(off.sin(), off.cos())
        low, high = problem.action_bounds
        action = torch.stack(
            (high[0] * off.cos().clamp(min=0), off / problem.dt_s), dim=1
        )
        drawn = {"samples": points} if step.draw else {}
        return (
            action.clamp(low, high),
            plan_state,
            Plan.empty(len(problem), here.device, **drawn),
        )
