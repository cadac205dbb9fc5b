"""The boundary between a planner and the loop: inputs are copied, outputs are checked.

A planner may write into its inputs without moving a robot or changing a map. An action
that no robot can execute is a fault of its episodes, never an error of the loop.
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
        action: finite actions; zeros within the bounds for faulty episodes, shape
            [B, A].
        plan_state: plan state for the next step.
        plan: its status has shape [B]; invalid layers are removed.
        faulty: mask of episodes with an invalid output, bool, shape [B].
        reason: what is wrong with the faulty ones, one line.
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
        problem: B problems; not changed, whatever the planner does.
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
        plan_state: from the last answer.
        problem: B problems that start at the robots' current states; not changed,
            whatever the planner does.
        generator: the planner's randomness, if it starts again.

    Returns:
        The next plan state.
    """
    copy = problem.clone()
    revised = planner.revise(plan_state, copy)
    return begin(planner, problem, generator) if revised is NotImplemented else revised


def act(planner: Planner[Any], step: Step, plan_state: Any, problem: Problem) -> Answer:
    """Return a planner's next actions, from copies of its inputs and checked.

    Args:
        planner: any planner; its exceptions pass through.
        step: robot states; not changed, whatever the planner does.
        plan_state: from `begin` or the last answer.
        problem: problem with the bounds of the actions; the planner does not get it.

    Returns:
        The answer. A wrong type, shape, dtype or device makes every episode faulty, a
        non-finite action only its own.
    """
    output = planner.plan(step.clone(), plan_state)
    standing = standing_actions(problem)
    no_layers = Plan.empty(len(problem), step.state.device)
    if fault := find_fault(output, problem):
        everyone = torch.ones_like(step.traversability, dtype=torch.bool)
        return Answer(standing, plan_state, no_layers, everyone, fault)
    action, following, plan = output
    faulty = ~action.detach().isfinite().all(dim=1)
    if find_layer_faults(plan, problem):
        plan = replace(no_layers, status=plan.status)
    return Answer(
        torch.where(faulty[:, None], standing, action.detach()),
        following,
        plan,
        faulty,
        NOT_FINITE,
    )


def standing_actions(problem: Problem) -> Tensor:
    """Return actions for episodes without a valid one: zeros within the bounds, [B, A]."""
    low, high = problem.action_bounds
    return torch.zeros_like(low).clamp(low, high).expand(len(problem), -1)


def find_fault(output: Any, problem: Problem) -> str:
    """Return the fault of a planner's output, in one line; empty without a fault.

    Args:
        output: return value of `plan`.
        problem: B problems, for the shape, dtype and device of actions.
    """
    if not isinstance(output, tuple) or len(output) != 3:
        got = (
            f"{len(output)} values"
            if isinstance(output, tuple)
            else type(output).__name__
        )
        return f"Expected (action, plan_state, Plan) from `plan`, got {got}."
    action, _, plan = output
    batch, like = len(problem), problem.start
    shape = batch, len(problem.robot.action_low)
    fault = find_tensor_fault("actions", action, like.dtype, shape, like.device)
    if fault:
        return fault
    if not isinstance(plan, Plan):
        return f"Expected a Plan beside the actions, got {type(plan).__name__}."
    return find_tensor_fault(
        "`Plan.status`", plan.status, torch.int64, (batch,), like.device
    )


def find_layer_faults(plan: Plan, problem: Problem) -> list[str]:
    """Return faults of the layers of a plan, a line each.

    Args:
        plan: any plan.
        problem: B problems.
    """
    faults = []
    for name, inner in LAYERS.items():
        layer, batch = getattr(plan, name), len(problem)
        got = list(layer.shape) if isinstance(layer, Tensor) else type(layer).__name__
        fits = isinstance(layer, Tensor) and layer.ndim == len(inner) + 2
        if not fits or (layer.shape[0], layer.shape[-1]) != (batch, 2):
            faults.append(
                f"Expected `Plan.{name}` of shape [{batch}, {', '.join(inner)}, 2], "
                f"got {got}."
            )
    return faults
