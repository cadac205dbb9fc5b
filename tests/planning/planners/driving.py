"""Closed loops of a planner and the simulation, for tests."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode

from benchnav.core import rng
from benchnav.planning.free_space import Immobile
from benchnav.planning.planners.mppi_rollouts import advance_chunk, roll_out
from benchnav.planning.planners.planner import rollout_path
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import World
from tests import factories


@dataclass(frozen=True)
class Drive:
    """What happened: outcome [B], steps [B], states [B, N + 1, S], actions [B, N, A]."""

    outcome: Tensor
    steps: Tensor
    states: Tensor
    actions: Tensor


def generator(seed: int = 0) -> torch.Generator:
    return rng.generator(rng.stream_key(seed, "test"))


def first(problem: Problem, draw: bool = False) -> Step:
    return step_at(problem.start, draw)


def step_at(state: Tensor, draw: bool = False) -> Step:
    return Step(
        state=state,
        traversability=torch.full_like(state[:, 0], torch.nan),
        time_s=0.0,
        draw=draw,
    )


def with_start(problem: Problem, *start: float) -> Problem:
    """The problem with all robots at a state."""
    return replace(problem, start=torch.tensor([start] * len(problem)))


def known_world(problem: Problem) -> World:
    """One λ field an episode, which immobilises robots as the problem says."""
    return World(
        noise="stored",
        immobile=problem.immobile,
        time_budget_s=float(problem.time_budget_s.max()),
    )


def drive(
    planner: Any,
    problem: Problem,
    truth: Tensor | None = None,
    time_budget_s: float = 60.0,
    immobile: Immobile | None = None,
    world: World | None = None,
) -> Drive:
    """Runs episodes where the truth is what is predicted, unless it is given, shape [B,
    H, W].
    """
    ground = problem.risk_map if truth is None else truth
    terrain = replace(factories.terrain(ground, 0.05), grid=problem.grid)
    world = world or World(time_budget_s=time_budget_s, immobile=immobile)
    noise = rng.stream_key(0, "noise")
    simulation = Simulation(
        terrain,
        problem.task,
        world,
        factories.places(problem.goal_m),
        noise,
        range(len(problem)),
    )
    now = simulation.init(problem.start)
    plan_state = planner.init(problem, generator())
    states, actions = [now.state], []
    observed = torch.full_like(problem.start[:, 0], torch.nan)
    while bool(now.running.any()):
        step = Step(
            state=now.state, traversability=observed, time_s=len(actions) * problem.dt_s
        )
        action, plan_state, _ = planner.plan(step, plan_state)
        now, observed = simulation.step(now, action)
        states.append(now.state)
        actions.append(action)
    return Drive(now.outcome, now.step, torch.stack(states, 1), torch.stack(actions, 1))


@contextmanager
def fake_cuda(problem: Problem) -> Iterator[Problem]:
    """The problem on tensors of a CUDA device that need no GPU: shapes and devices
    alone are followed.
    """
    with FakeTensorMode(allow_non_fake_inputs=True):
        moved = problem.to("cuda")
        assert moved.start.device.type == "cuda"
        assert isinstance(moved.free, FakeTensor)
        yield moved


def on_cuda(*tensors: Tensor) -> bool:
    return all(tensor.device.type == "cuda" for tensor in tensors)


def rollout_cost(
    problem: Problem, state: Tensor, mean: Tensor, noise: Tensor, target_m: Tensor
) -> Tensor:
    """J and the penalty of ground that is not free along MPPI's sampled action
    sequences, shape [B, K].
    """
    states, cost, _ = roll_out(problem, state, mean, noise, target_m, advance_chunk)
    return cost + problem.terminal_cost(states, target_m[:, None])


def held_paths(problem: Problem, state: Tensor, pairs: Tensor, steps: int) -> Tensor:
    """Positions along pairs (v, ω) [B, M, 2] that are held, the first included, shape
    [B, M, T + 1, 2].
    """
    return rollout_path(problem, state, pairs.mT[:, None].expand(-1, steps, -1, -1))
