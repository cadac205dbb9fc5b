"""Policies as planners.

A policy that was trained in `benchnav/OffRoad-v1` is evaluated on the same episodes as
any planner.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.core.ground import SEEN
from benchnav.env.view import MapKnowledge, View
from benchnav.planning.planners.planner import Plan, Planner
from benchnav.planning.problem import Problem, Task
from benchnav.planning.sensing.sensor import Step

Policy = Callable[[dict[str, np.ndarray]], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class PolicyState(Batch):
    """Plan state of a policy.

    Args:
        problem: B problems.
        knowledge: knowledge of the terrain in each problem.
    """

    problem: Problem
    knowledge: MapKnowledge


class PolicyPlanner(Planner[PolicyState]):
    """Planner that follows a policy of `benchnav/OffRoad-v1`.

    To use a policy on the command line, write a subclass in a file. The parameters of
    its constructor are the planner's options:

        class Mine(PolicyPlanner):
            def __init__(self, path: str = "policy.zip"):
                super().__init__(load(path), normalised_actions=True)

    Args:
        policy: function from a batch of observations to actions, shape [B, A]. The
            action of an episode may depend only on the episode's observation.
        crop_cells: number of rows and of columns of the crop, ≥ 2, as in training.
        crop_behind: fraction of the crop's length that is behind the robot, in [0, 1),
            as in training.
        normalised_actions: whether actions are in [−1, 1], scaled to the robot's
            bounds, as in training.
    """

    def __init__(
        self,
        policy: Policy,
        crop_cells: int = 32,
        crop_behind: float = 1 / 3,
        normalised_actions: bool = False,
    ) -> None:
        """Create the planner; the policy is not called."""
        self.policy = policy
        self.normalised_actions = normalised_actions
        self.view = View(cells=crop_cells, behind=crop_behind)

    def follows(self, task: Task) -> str:
        """Return a text which says that no objective is minimised; see `Planner`."""
        return "none (a policy, which does what it was trained for)"

    def init(self, problem: Problem, generator: torch.Generator) -> PolicyState:
        """Return the plan state, with the predicted λ; see `Planner`."""
        knowledge = _knowledge_of(problem)
        return PolicyState(problem=problem, knowledge=knowledge)

    def plan(
        self, step: Step, plan_state: PolicyState
    ) -> tuple[Tensor, PolicyState, Plan]:
        """Return the actions of the policy; see `Planner`.

        Raises:
            ConfigError: If the policy returns actions of another shape.
        """
        problem = plan_state.problem
        observations = self.observe(step, plan_state)
        result = self.policy(observations)
        array = np.asarray(result, np.float32)
        low, high = problem.action_bounds
        shape = list(array.shape)
        expected_shape = [len(problem), len(low)]
        expect(
            shape == expected_shape,
            f"actions of shape {expected_shape} from the policy, got {shape}.",
        )
        action = torch.from_numpy(array).to(step.state)
        if self.normalised_actions:
            action = low + (action + 1) / 2 * (high - low)
        plan = Plan.empty(len(problem), action.device)
        return action.clamp(low, high), plan_state, plan

    def observe(self, step: Step, plan_state: PolicyState) -> dict[str, np.ndarray]:
        """Return the observations of `benchnav/OffRoad-v1` for B episodes.

        Args:
            step: states of the robots, and λ that they observed in the last step.
            plan_state: plan state of B episodes.

        Returns:
            `crop`, shape [B, 4, N, N], and `state`, shape [B, 5 + S − 3], both float32;
            see `benchnav.env.view.View.observe`.
        """
        problem = plan_state.problem
        time_left = 1 - step.time_s / problem.time_budget_s
        observations = self.view.observe(
            problem.grid,
            plan_state.knowledge,
            step.state,
            problem.goal_m,
            step.traversability,
            time_left,
        )
        return {name: values.cpu().numpy() for name, values in observations.items()}

    def revise(self, plan_state: PolicyState, problem: Problem) -> PolicyState:
        """Return the plan state with the updated λ; see `Planner`."""
        knowledge = _knowledge_of(problem)
        return PolicyState(problem=problem, knowledge=knowledge)

    def select(self, plan_state: PolicyState, members: Tensor) -> PolicyState:
        """Return the plan state of some episodes; see `Planner`."""
        return plan_state.select(members)


def _knowledge_of(problem: Problem) -> MapKnowledge:
    """Return the knowledge of the terrain in a batch of problems."""
    layer = problem.observation.layers.get(SEEN)
    seen = torch.ones_like(problem.free) if layer is None else layer > 0
    return MapKnowledge(
        risk_map=problem.risk_map,
        spread=problem.distribution.spread(),
        elevation_m=problem.elevation_m,
        seen=seen,
    )
