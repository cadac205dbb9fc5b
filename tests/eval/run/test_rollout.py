from types import SimpleNamespace
from typing import Any

import pytest
import torch

from benchnav.eval.run import rollout
from benchnav.planning.planners.planner import Plan, Step
from benchnav.planning.problem import Problem
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import World
from tests import factories

BATCH = 2


class Clock:
    """Time that passes only where a planner says so."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now


class Slow:
    """Stands still; takes 5 s to begin, and 1 s for its first step, 2 s for its second and so on."""

    def __init__(self, clock: Clock, raises_at: int = 99) -> None:
        self.clock = clock
        self.raises_at = raises_at

    def init(self, problem: Problem, generator: torch.Generator) -> int:
        self.clock.now += 5
        return 1

    def plan(self, step: Step, plan_state: int) -> Any:
        self.clock.now += plan_state
        if plan_state == self.raises_at:
            raise RuntimeError("enough")
        return torch.zeros(BATCH, 2), plan_state + 1, Plan.empty(BATCH)


def run(monkeypatch: pytest.MonkeyPatch, **options: int) -> rollout.Episodes:
    clock = Clock()
    monkeypatch.setattr(rollout, "time", SimpleNamespace(perf_counter=clock.perf_counter))
    ground, world = torch.full((BATCH, 16, 16), 0.8), World(time_budget_s=0.4)
    problem = factories.problem(ground, time_budget_s=0.4)
    goal = torch.tensor([[6.75, 6.75]] * BATCH)
    simulation = Simulation(
        factories.terrain(ground), factories.task(), world, factories.places(goal), 0, range(BATCH)
    )
    return rollout.run_episodes(Slow(clock, **options), problem, simulation, torch.Generator())


def test_wall_time_is_told_of_the_beginning_and_of_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    episodes = run(monkeypatch)
    assert episodes.begin_s == 5
    assert episodes.planning_s.tolist() == [1, 2, 3, 4]
    assert episodes.actions.shape[1] == 4


def test_a_plan_that_was_never_made_has_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    episodes = run(monkeypatch, raises_at=3)
    assert episodes.planning_s.tolist() == [1, 2]
    assert episodes.errors == ("RuntimeError: enough",) * BATCH
