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
        problem = plan_state
        position, heading = step.state[:, :2], step.state[:, 2]
        device = position.device
        to_goal = problem.goal_m - position
        bearing = torch.atan2(to_goal[:, 1], to_goal[:, 0])
        turns = torch.arange(self.rays, device=device) * (2 * math.pi / self.rays)
        angles = bearing[:, None] + turns  # [B, R]
        # Rays do not extend beyond the goal.
        length = to_goal.norm(dim=1).clamp(max=self.length_m)[:, None]
        directions = torch.stack((angles.cos(), angles.sin()), dim=-1)  # [B, R, 2]
        rays = directions * length[..., None]
        fractions = torch.linspace(0.1, 1, 10, device=device)[:, None]
        points = position[:, None, None] + fractions * rays[:, :, None]  # [B, R, N, 2]
        headings = angles[:, :, None, None].expand(*points.shape[:3], 1)
        poses = torch.cat((points, headings), dim=-1)
        # λ̂ is 0 off the map.
        pace = 1 / problem.traversability_at(poses).clamp(min=1e-3)
        pace = torch.where(problem.free_at(poses), pace, 1e3)
        remaining = (problem.goal_m[:, None] - points[:, :, -1]).norm(dim=-1)
        cost = length * pace.mean(dim=-1) + remaining
        best = cost.argmin(dim=1, keepdim=True)  # [B, 1]
        turn = angles.gather(1, best).squeeze(1) - heading
        turn = torch.atan2(turn.sin(), turn.cos())
        low, high = problem.action_bounds
        speed = high[0] * turn.cos().clamp(min=0)
        action = torch.stack((speed, turn / problem.dt_s), dim=1)
        drawn = {"samples": points} if step.draw else {}
        plan = Plan.empty(len(problem), device, **drawn)
        return action.clamp(low, high), plan_state, plan
