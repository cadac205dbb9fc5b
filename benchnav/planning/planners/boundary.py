"""The boundary between a planner and what it steers: copies go out, what comes back is checked.

A planner may write into whatever it is given without moving a robot or changing a map. An answer that no
robot can carry out is a fault of its episodes, never an error of the loop. Letters in shapes: B episodes,
S state and A action dimensions.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.planning.planners.planner import Plan, Planner, Step
from benchnav.planning.problem import Problem

NOT_FINITE = "Expected finite actions, got some that are not."

# Dimensions of each layer of a `Plan`; the first is B, the last holds x and y.
_LAYERS = {"path": 3, "samples": 4, "reference": 3, "tree": 4}


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a planner said, made safe.

    Args:
        action: finite actions; zeros within the bounds for faulty episodes, shape [B, A].
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


def act(planner: Planner[Any], step: Step, plan_state: Any, problem: Problem) -> Answer:
    """Asks a planner for the next actions, on copies, and checks what it answers.

    Args:
        planner: any planner; what it raises passes through.
        step: where the robots are; not changed, whatever the planner does.
        plan_state: from `begin` or the last answer.
        problem: for the bounds of the actions; the planner is not given it.

    Returns:
        The answer. A wrong type, shape, dtype or device makes every episode faulty, an action that is not
        finite its own alone.
    """
    given = replace(step, state=step.state.clone(), traversability=step.traversability.clone())
    said = planner.plan(given, plan_state)
    standing = standing_actions(problem)
    fault = find_fault(said, problem)
    if fault:
        everyone = torch.ones_like(step.traversability, dtype=torch.bool)
        nothing = Plan.empty(len(problem), step.state.device)
        return Answer(action=standing, plan_state=plan_state, plan=nothing, faulty=everyone, reason=fault)
    action, following, plan = said
    faulty = ~action.detach().isfinite().all(dim=1)
    if find_layer_faults(plan, problem):
        plan = Plan.empty(len(problem), step.state.device, status=plan.status)
    return Answer(
        action=torch.where(faulty[:, None], standing, action.detach()),
        plan_state=following,
        plan=plan,
        faulty=faulty,
        reason=NOT_FINITE,
    )


def standing_actions(problem: Problem) -> Tensor:
    """What harms least where there is no answer: zeros, within the bounds, shape [B, A]."""
    return torch.zeros_like(problem.action_bounds[0]).clamp(*problem.action_bounds).expand(len(problem), -1)


def find_fault(said: Any, problem: Problem) -> str:
    """Tells what makes a whole answer useless, in one line; empty where nothing does.

    Args:
        said: whatever `plan` returned.
        problem: B problems, for the shape, dtype and device that actions need.
    """
    if not isinstance(said, tuple) or len(said) != 3:
        got = f"{len(said)} values" if isinstance(said, tuple) else type(said).__name__
        return f"Expected (action, plan_state, Plan) from `plan`, got {got}."
    action, _, plan = said
    batch, like = len(problem), problem.start
    shape = [batch, len(problem.robot.action_low)]
    if not isinstance(action, Tensor):
        return f"Expected actions as a tensor of shape {shape}, got {type(action).__name__}."
    if list(action.shape) != shape:
        return f"Expected actions of shape {shape}, got {list(action.shape)}."
    if action.dtype != like.dtype:
        return f"Expected actions of the states' dtype {like.dtype}, got {action.dtype}."
    if action.device != like.device:
        return f"Expected actions on the states' device {like.device}, got {action.device}."
    if not isinstance(plan, Plan):
        return f"Expected a Plan beside the actions, got {type(plan).__name__}."
    return _status_fault(plan.status, batch, like.device)


def find_layer_faults(plan: Plan, problem: Problem) -> list[str]:
    """Tells which layers of a plan cannot be drawn, a line each.

    Args:
        plan: any plan.
        problem: B problems.
    """
    faults = []
    for name, dimensions in _LAYERS.items():
        layer = getattr(plan, name)
        if not isinstance(layer, Tensor):
            faults.append(f"Expected `Plan.{name}` as a tensor, got {type(layer).__name__}.")
        elif layer.ndim != dimensions or layer.shape[0] != len(problem) or layer.shape[-1] != 2:
            between = ", ".join(["M", "N"][4 - dimensions :])
            faults.append(
                f"Expected `Plan.{name}` of shape [{len(problem)}, {between}, 2], got {list(layer.shape)}."
            )
    return faults


def _status_fault(status: Any, batch: int, device: torch.device) -> str:
    if not isinstance(status, Tensor):
        return f"Expected `Plan.status` as a tensor of shape [{batch}], got {type(status).__name__}."
    if list(status.shape) != [batch]:
        return f"Expected `Plan.status` of shape [{batch}], got {list(status.shape)}."
    if status.dtype != torch.int64:
        return f"Expected `Plan.status` as int64, got {status.dtype}."
    if status.device != device:
        return f"Expected `Plan.status` on the states' device {device}, got {status.device}."
    return ""
