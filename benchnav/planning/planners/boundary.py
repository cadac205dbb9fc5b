"""The boundary between a planner and the loop: inputs are copied, outputs are checked.

A planner that writes into its inputs neither moves a robot nor changes a map. An action
that no robot can execute is a fault of its episode, and not an error of the loop.
Letters in shapes: B episodes, S state and A action dimensions.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core.batch import find_tensor_fault
from benchnav.planning.planners.planner import LAYERS, Plan, Planner
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.sensor import Step

NOT_FINITE = "Expected finite actions, got some that are not."


@dataclass(frozen=True)
class Answer:
    """A planner's output after checks.

    Args:
        action: finite actions; zeros, clipped to the bounds, for faulty episodes, shape
            [B, A].
        plan_state: plan state for the next step.
        plan: plan without invalid layers; its status has shape [B].
        faulty: mask of episodes with an invalid output, bool, shape [B].
        reason: fault of the faulty episodes, in one line.
    """

    action: Tensor
    plan_state: Any
    plan: Plan
    faulty: Tensor
    reason: str


def begin(planner: Planner[Any], problem: Problem, generator: torch.Generator) -> Any:
    """Initialise a planner on a copy of the problem.

    Args:
        planner: any planner; its exceptions pass through.
        problem: B problems; not modified, whatever the planner does.
        generator: the planner's randomness.

    Returns:
        The first plan state.
    """
    return planner.init(problem.clone(), generator)


def revise(
    planner: Planner[Any], plan_state: Any, problem: Problem, generator: torch.Generator
) -> Any:
    """Replan on a copy of a problem with another λ̂, by `revise` or again by `init`.

    Args:
        planner: any planner; its exceptions pass through.
        plan_state: plan state of the last answer.
        problem: B problems that start at the robots' current states; not modified,
            whatever the planner does.
        generator: the planner's randomness, if it starts again.

    Returns:
        The next plan state.
    """
    revised = planner.revise(plan_state, problem.clone())
    if revised is NotImplemented:
        return begin(planner, problem, generator)
    return revised


def act(planner: Planner[Any], step: Step, plan_state: Any, problem: Problem) -> Answer:
    """Return a planner's next actions, from copies of its inputs and checked.

    Args:
        planner: any planner; its exceptions pass through.
        step: robot states; not modified, whatever the planner does.
        plan_state: plan state from `begin` or the last answer.
        problem: problem with the bounds of the actions, not passed to the planner.

    Returns:
        The answer. A wrong type, shape, dtype or device makes every episode faulty, and
        a non-finite action only its own episode.
    """
    output = planner.plan(step.clone(), plan_state)
    standing = standing_actions(problem)
    no_layers = Plan.empty(len(problem), step.state.device)
    if fault := find_fault(output, problem):
        everyone = torch.ones_like(step.traversability, dtype=torch.bool)
        return Answer(standing, plan_state, no_layers, everyone, fault)
    action, next_state, plan = output
    action = action.detach()
    faulty = ~action.isfinite().all(dim=1)
    action = torch.where(faulty[:, None], standing, action)
    if find_layer_faults(plan, problem):
        plan = replace(no_layers, status=plan.status)
    return Answer(action, next_state, plan, faulty, NOT_FINITE)


def standing_actions(problem: Problem) -> Tensor:
    """Return actions for faulty episodes: zeros, clipped to the bounds, shape [B, A]."""
    low, high = problem.action_bounds
    standing = torch.zeros_like(low).clamp(low, high)
    return standing.expand(len(problem), -1)


def find_fault(output: Any, problem: Problem) -> str:
    """Return the fault of a planner's output, in one line; empty without a fault.

    Args:
        output: return value of `plan`.
        problem: B problems, for the shape, dtype and device of actions.
    """
    got = type(output).__name__
    if isinstance(output, tuple):
        got = f"{len(output)} values"
    if not isinstance(output, tuple) or len(output) != 3:
        return f"Expected (action, plan_state, Plan) from `plan`, got {got}."
    action, _, plan = output
    start = problem.start
    n_episodes = len(problem)
    shape = n_episodes, len(problem.robot.action_low)
    fault = find_tensor_fault("actions", action, start.dtype, shape, start.device)
    if fault:
        return fault
    if not isinstance(plan, Plan):
        return f"Expected a Plan as the last output, got {type(plan).__name__}."
    status = plan.status
    return find_tensor_fault(
        "`Plan.status`", status, torch.int64, (n_episodes,), start.device
    )


def find_layer_faults(plan: Plan, problem: Problem) -> list[str]:
    """Return faults of the layers of a plan, a line each.

    Args:
        plan: any plan.
        problem: B problems.
    """
    n_episodes = len(problem)
    faults = []
    for name, inner in LAYERS.items():
        layer = getattr(plan, name)
        got: object = type(layer).__name__
        fits = False
        if isinstance(layer, Tensor):
            got = list(layer.shape)
            has_dims = layer.ndim == len(inner) + 2
            fits = has_dims and (layer.shape[0], layer.shape[-1]) == (n_episodes, 2)
        if not fits:
            faults.append(
                f"Expected `Plan.{name}` of shape "
                f"[{n_episodes}, {', '.join(inner)}, 2], got {got}."
            )
    return faults
