"""Running episodes: a planner and the simulation in a closed loop, as one batch.

Letters in shapes: B episodes, N steps, S state and A action dimensions.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchnav.planning.planner import Plan, Planner, PlanStatus
from benchnav.planning.problem import Problem
from benchnav.planning.simulation import Simulation, fail, tell_stuck

Watcher = Callable[[int, Plan], None]


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """What happened in a batch of episodes. Beyond an episode's own `steps` its state stands still.

    Args:
        states: shape [B, N + 1, S].
        actions: shape [B, N, A].
        traversability: λ that the robot met at each step, shape [B, N].
        outcome: `simulation.Outcome`, shape [B].
        steps: steps to the end, shape [B].
        planning_s: wall time spent in the planner.
    """

    states: Tensor
    actions: Tensor
    traversability: Tensor
    outcome: Tensor
    steps: Tensor
    planning_s: float


def run_episodes(
    planner: Planner[Any],
    problem: Problem,
    simulation: Simulation,
    generator: torch.Generator,
    watch: Watcher | None = None,
) -> Episodes:
    """Runs a batch of episodes to the end of the last.

    Args:
        planner: chooses actions; it is given the problem alone, never the truth.
        problem: with predicted traversability.
        simulation: with the true terrain.
        generator: the planner's randomness.
        watch: is called with each step's number and plan, before the step is taken.

    Returns:
        What happened.
    """
    now = simulation.init(problem.start)
    states = [now.state]
    actions: list[Tensor] = []
    met: list[Tensor] = []
    began = time.perf_counter()
    plan_state = planner.init(problem, generator)
    planning_s = time.perf_counter() - began
    while bool(now.running.any()):
        began = time.perf_counter()
        action, plan_state, plan = planner.plan(now.state, plan_state)
        planning_s += time.perf_counter() - began
        if watch:
            watch(len(actions), plan)
        now = fail(now, plan.status == PlanStatus.FAILED)
        now, traversability = simulation.step(now, action)
        states.append(now.state)
        actions.append(action)
        met.append(traversability)
    track = torch.stack(states, dim=1)
    return Episodes(
        states=track,
        actions=torch.stack(actions, dim=1),
        traversability=torch.stack(met, dim=1),
        outcome=tell_stuck(now.outcome, track[..., :2], problem.dt_s),
        steps=now.step,
        planning_s=planning_s,
    )
