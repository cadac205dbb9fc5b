"""Calls of a planner by the evaluation: inputs are copied, and outputs are checked.

A planner that modifies its inputs hence neither moves a robot nor changes a map. An
invalid action ends only its own episode, and not the evaluation. Letters in shapes: B
episodes, A action dimensions.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core.batch import find_tensor_fault
from benchnav.planning.planners.planner import LAYERS, Plan, Planner
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.sensor import Step

NOT_FINITE = "Expected finite actions, got NaN or infinite values."


@dataclass(frozen=True)
class Answer:
    """A planner's output after checks.

    Args:
        action: finite actions, shape [B, A]; zeros, clipped to the robot's bounds, for
            faulty episodes.
        plan_state: plan state for the next step.
        plan: plan, whose layers are empty if one of them is invalid.
        faulty: mask of episodes with an invalid output, bool, shape [B].
        reason: message about the invalid output, in one line.
    """

    action: Tensor
    plan_state: Any
    plan: Plan
    faulty: Tensor
    reason: str


def begin(planner: Planner[Any], problem: Problem, generator: torch.Generator) -> Any:
    """Return a planner's first plan state, from a copy of the problem.

    Args:
        planner: any planner; its exceptions are not caught.
        problem: B problems, which a planner cannot modify.
        generator: random generator of the planner.
    """
    return planner.init(problem.clone(), generator)


def revise(
    planner: Planner[Any], plan_state: Any, problem: Problem, generator: torch.Generator
) -> Any:
    """Return a planner's plan state for a new prediction, from a copy of the problem.

    A planner without `revise` starts again with `init`.

    Args:
        planner: any planner; its exceptions are not caught.
        plan_state: plan state of the last answer.
        problem: B problems that start at the robots' current states, which a planner
            cannot modify.
        generator: random generator of a planner that starts again.
    """
    revised = planner.revise(plan_state, problem.clone())
    if revised is NotImplemented:
        return begin(planner, problem, generator)
    return revised


def act(planner: Planner[Any], step: Step, plan_state: Any, problem: Problem) -> Answer:
    """Return a planner's next actions, computed from copies of its inputs and checked.

    Args:
        planner: any planner; its exceptions are not caught.
        step: robot states, which a planner cannot modify.
        plan_state: plan state from `begin`, `revise` or the last answer.
        problem: B problems with the bounds of the actions, for the checks.

    Returns:
        The answer. If the output has a wrong type, shape, dtype or device, all episodes
        are faulty. If an action is NaN or infinite, only its episode is faulty.
    """
    output = planner.plan(step.clone(), plan_state)
    standing = standing_actions(problem)
    no_layers = Plan.empty(len(problem), step.state.device)
    if fault := find_fault(output, problem):
        all_faulty = torch.ones_like(step.traversability, dtype=torch.bool)
        return Answer(standing, plan_state, no_layers, all_faulty, fault)
    action, next_state, plan = output
    action = action.detach()
    faulty = ~action.isfinite().all(dim=1)
    action = torch.where(faulty[:, None], standing, action)
    if find_layer_faults(plan, problem):
        plan = replace(no_layers, status=plan.status)
    return Answer(action, next_state, plan, faulty, NOT_FINITE)


def standing_actions(problem: Problem) -> Tensor:
    """Return zero actions for faulty episodes, clipped to the bounds, shape [B, A]."""
    low, high = problem.action_bounds
    standing = torch.zeros_like(low).clamp(low, high)
    return standing.expand(len(problem), -1)


def find_fault(output: Any, problem: Problem) -> str:
    """Return a message about a planner's output, in one line; empty if it is valid.

    Args:
        output: return value of `plan`.
        problem: B problems, for the shape, dtype and device of actions.
    """
    got = type(output).__name__
    if isinstance(output, tuple):
        got = f"{len(output)} values"
    if not isinstance(output, tuple) or len(output) != 3:
        return f"Expected `plan` to return (action, plan_state, Plan), got {got}."
    action, _, plan = output
    start = problem.start
    n_episodes = len(problem)
    shape = n_episodes, len(problem.robot.action_low)
    fault = find_tensor_fault("actions", action, start.dtype, shape, start.device)
    if fault:
        return fault
    if not isinstance(plan, Plan):
        return (
            "Expected `plan` to return a Plan as its third value, got "
            f"{type(plan).__name__}."
        )
    status = plan.status
    return find_tensor_fault(
        "`Plan.status`", status, torch.int64, (n_episodes,), start.device
    )


def find_layer_faults(plan: Plan, problem: Problem) -> list[str]:
    """Return messages about the invalid layers of a plan, one line each.

    Args:
        plan: any plan.
        problem: B problems, for the shapes of layers.
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
