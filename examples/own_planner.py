"""A custom planner: full speed along the best of a fan of arcs.

    benchnav-eval run --planners '[straight,examples/own_planner.py:Fan]' --risks '[mean,cvar:0.9]' --out runs/fan

Commands find the planner by its file. The parameters of its constructor are its
options, as in `{part: examples/own_planner.py:Fan, label: wide fan, options: {arcs:
31}}`. To test it, call `benchnav.testing.check_planner("examples/own_planner.py:Fan")`.
"""

import torch

from benchnav.planning import Plan, Planner, Problem, Step


class Fan(Planner[Problem]):
    """Planner that rolls out arcs under λ̂ and follows the arc of minimum cost.

    Args:
        arcs: number of arcs.
        horizon_s: duration of a rollout in seconds.
    """

    steers = (("speed_mps", "turn_rate_radps"), ("speed_mps", "steering_rad"))

    def __init__(self, arcs: int = 15, horizon_s: float = 3.0) -> None:
        self.arcs, self.horizon_s = arcs, horizon_s

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        return problem  # the plan state, which is passed from step to step

    def plan(
        self, step: Step, plan_state: Problem
    ) -> tuple[torch.Tensor, Problem, Plan]:
        problem = plan_state
        low, high = problem.action_bounds
        turns = (
            torch.linspace(0, 1, self.arcs, device=low.device) * (high[1] - low[1])
            + low[1]
        )
        actions = torch.stack((high[0].expand_as(turns), turns), dim=1)  # [M, 2]
        state = step.state[:, None].expand(-1, self.arcs, -1)  # [B, M, S]
        target, cost, path = problem.goal_m[:, None], 0.0, [state[..., :2]]
        for _ in range(round(self.horizon_s / problem.dt_s)):
            ground = problem.ground_at(state)
            cost = cost + problem.stage_cost(state, actions, ground, target)
            state = problem.robot(state, actions, ground.abs())
            path.append(state[..., :2])
        best = (cost + problem.terminal_cost(state, target)).argmin(dim=1)
        drawn = {"samples": torch.stack(path, dim=2)} if step.draw else {}
        return (
            actions[best],
            plan_state,
            Plan.empty(len(problem), state.device, **drawn),
        )
