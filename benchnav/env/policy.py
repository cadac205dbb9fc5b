"""Policies as planners: what was trained in `benchnav/OffRoad-v1` meets the same
episodes as any planner.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.core.ground import SEEN
from benchnav.env.view import Known, View
from benchnav.planning.planners.planner import Plan, Planner
from benchnav.planning.problem import Problem, Task
from benchnav.planning.sensing.sensor import Step

Policy = Callable[[dict[str, np.ndarray]], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class PolicyState(Batch):
    """What a policy's planner keeps.

    Args:
        problem: B problems.
        known: of the ground.
    """

    problem: Problem
    known: Known


class PolicyPlanner(Planner[PolicyState]):
    """Drives as a policy says that is given the observations of `benchnav/OffRoad-v1`.

    A policy in a file is named on the command line through a subclass, whose
    constructor's parameters are its options:

        class Mine(PolicyPlanner):
            def __init__(self, path: str = "policy.zip"):
                super().__init__(load(path), normalised_actions=True)

    Args:
        policy: gives actions, shape [B, A], from a batch of observations; each is for
            its own observation alone.
        crop_cells: as the environment had in training.
        crop_behind: likewise.
        normalised_actions: likewise.
    """

    def __init__(
        self,
        policy: Policy,
        crop_cells: int = 32,
        crop_behind: float = 1 / 3,
        normalised_actions: bool = False,
    ) -> None:
        """Keeps the policy."""
        self.policy, self.normalised_actions = policy, normalised_actions
        self.view = View(cells=crop_cells, behind=crop_behind)

    def follows(self, task: Task) -> str:
        """That it minimises nothing; see `Planner`."""
        return "none (a policy, which does what it was trained for)"

    def init(self, problem: Problem, generator: torch.Generator) -> PolicyState:
        """Keeps what is predicted; draws nothing. See `Planner`."""
        return PolicyState(problem=problem, known=_known_of(problem))

    def plan(
        self, step: Step, plan_state: PolicyState
    ) -> tuple[Tensor, PolicyState, Plan]:
        """Asks the policy; see `Planner`."""
        problem = plan_state.problem
        given = self.observe(step, plan_state)
        answer = np.asarray(self.policy(given), np.float32)
        low, high = problem.action_bounds
        expected = [len(problem), len(low)]
        expect(
            list(answer.shape) == expected,
            f"actions of shape {expected} from the policy, got {list(answer.shape)}.",
        )
        action = torch.from_numpy(answer).to(step.state)
        if self.normalised_actions:
            action = low + (action + 1) / 2 * (high - low)
        return (
            action.clamp(low, high),
            plan_state,
            Plan.empty(len(problem), action.device),
        )

    def observe(self, step: Step, plan_state: PolicyState) -> dict[str, np.ndarray]:
        """The observations of `benchnav/OffRoad-v1`, of B episodes.

        Args:
            step: where the robots are.
            plan_state: what is known.
        """
        problem = plan_state.problem
        time_left = 1 - step.time_s / problem.time_budget_s
        seen = self.view.observe(
            problem.grid,
            plan_state.known,
            step.state,
            problem.goal_m,
            step.traversability,
            time_left,
        )
        return {name: values.cpu().numpy() for name, values in seen.items()}

    def revise(self, plan_state: PolicyState, problem: Problem) -> PolicyState:
        """Goes on under what is known now; see `Planner`."""
        return PolicyState(problem=problem, known=_known_of(problem))

    def select(self, plan_state: PolicyState, members: Tensor) -> PolicyState:
        """Keeps some episodes; see `Planner`."""
        return plan_state.select(members)


def _known_of(problem: Problem) -> Known:
    """What is known of the ground in a batch of problems."""
    seen = problem.observation.layers.get(SEEN)
    return Known(
        risk_map=problem.risk_map,
        spread=problem.distribution.spread(),
        elevation_m=problem.elevation_m,
        seen=torch.ones_like(problem.free) if seen is None else seen > 0,
    )
