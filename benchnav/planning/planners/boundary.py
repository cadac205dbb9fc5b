"""The boundary between a planner and what it steers: copies go out, what comes back is
checked.

A planner may write into whatever it is given without moving a robot or changing a map.
An answer that no robot can carry out is a fault of its episodes, never an error of the
loop. Letters in shapes: B episodes, S state and A action dimensions.
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
    """What a planner said, made safe.

    Args:
        action: finite actions; zeros within the bounds for faulty episodes, shape [B,
            A].
        plan_state: to be handed back at the next step.
        plan: its status has shape [B]; layers that cannot be drawn are left out.
        faulty: which episodes got what no robot can do, bool, shape [B].
        reason: what is wrong with the faulty ones, one line.
    """

    action: Tensor
    plan_state: Any
    plan: Plan
    faulty: Tensor
    reason: str


def begin(planner: Planner[Any], problem: Problem, generator: torch.Generator) -> Any:
    """Lets a planner prepare on a copy of the problem.

    Args:
        planner: any planner; what it raises passes through.
        problem: B problems; not changed, whatever the planner does.
        generator: the planner's randomness.

    Returns:
        The first plan state.
    """
    return planner.init(problem.clone(), generator)


def revise(
    planner: Planner[Any], plan_state: Any, problem: Problem, generator: torch.Generator
) -> Any:
    """Lets a planner go on under another λ̂, on a copy of the problem; one that cannot
    begins anew.

    Args:
        planner: any planner; what it raises passes through.
        plan_state: from the last answer.
        problem: B problems that start where the robots are; not changed, whatever the
            planner does.
        generator: the planner's randomness, for one that begins anew.

    Returns:
        The next plan state.
    """
    copy = problem.clone()
    revised = planner.revise(plan_state, copy)
    return begin(planner, problem, generator) if revised is NotImplemented else revised


def act(planner: Planner[Any], step: Step, plan_state: Any, problem: Problem) -> Answer:
    """Asks a planner for the next actions, on copies, and checks what it answers.

    Args:
        planner: any planner; what it raises passes through.
        step: where the robots are; not changed, whatever the planner does.
        plan_state: from `begin` or the last answer.
        problem: for the bounds of the actions; the planner is not given it.

    Returns:
        The answer. A wrong type, shape, dtype or device makes every episode faulty, an
        action that is not finite its own alone.
    """
    output = planner.plan(step.clone(), plan_state)
    standing, nothing = (
        standing_actions(problem),
        Plan.empty(len(problem), step.state.device),
    )
    if fault := find_fault(output, problem):
        everyone = torch.ones_like(step.traversability, dtype=torch.bool)
        return Answer(standing, plan_state, nothing, everyone, fault)
    action, following, plan = output
    faulty = ~action.detach().isfinite().all(dim=1)
    if find_layer_faults(plan, problem):
        plan = replace(nothing, status=plan.status)
    return Answer(
        torch.where(faulty[:, None], standing, action.detach()),
        following,
        plan,
        faulty,
        NOT_FINITE,
    )


def standing_actions(problem: Problem) -> Tensor:
    """What harms least where there is no answer: zeros, within the bounds, shape [B,
    A].
    """
    return (
        torch.zeros_like(problem.action_bounds[0])
        .clamp(*problem.action_bounds)
        .expand(len(problem), -1)
    )


def find_fault(output: Any, problem: Problem) -> str:
    """Tells what makes a whole answer useless, in one line; empty where nothing does.

    Args:
        said: whatever `plan` returned.
        problem: B problems, for the shape, dtype and device that actions need.
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
    if fault := find_tensor_fault(
        "actions",
        action,
        like.dtype,
        (batch, len(problem.robot.action_low)),
        like.device,
    ):
        return fault
    if not isinstance(plan, Plan):
        return f"Expected a Plan beside the actions, got {type(plan).__name__}."
    return find_tensor_fault(
        "`Plan.status`", plan.status, torch.int64, (batch,), like.device
    )


def find_layer_faults(plan: Plan, problem: Problem) -> list[str]:
    """Tells which layers of a plan cannot be drawn, a line each.

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
