"""The contract of a planner, for every one that is known by name."""

from dataclasses import fields

import pytest
import torch

from benchnav import rng
from benchnav.errors import ConfigError
from benchnav.eval.rollout import run_episodes
from benchnav.planning import planner
from benchnav.planning.planner import Plan, PlanStatus, make_planner, planner_names, register
from benchnav.planning.problem import Problem
from benchnav.planning.simulation import Outcome, Simulation
from tests import factories

OPTIONS = {"mppi": {"samples": 256}, "cl_rrt": {"expansions": 200}}
NAMES = planner_names()


def gap(batch: int = 2) -> torch.Tensor:
    """A wall across the map with a gap of 2 m."""
    ground = torch.full((batch, 24, 24), 0.85)
    ground[:, 11:13, :] = 0.1
    ground[:, 11:13, 15:19] = 0.85
    return ground


def problem_with_gap() -> Problem:
    return factories.problem(gap(), start=(3.0, 2.5), goal=(6.0, 10.0))


def generator() -> torch.Generator:
    return rng.generator(rng.stream_key(0, "test"))


def drive(name: str, problem: Problem):  # type: ignore[no-untyped-def]
    truth = factories.terrain(problem.traversability, 0.05)
    luck = rng.stream_key(0, "luck")
    simulation = Simulation(truth, problem.dynamics, problem.goal_m, luck, range(len(problem)))
    return run_episodes(make_planner(name, OPTIONS.get(name)), problem, simulation, generator())


def copies(value: object) -> dict[str, torch.Tensor]:
    return {f.name: v.clone() for f in fields(value) if torch.is_tensor(v := getattr(value, f.name))}  # type: ignore[arg-type]


@pytest.mark.parametrize("name", NAMES)
def test_it_drives_to_the_goal_through_free_space(name: str) -> None:
    episodes = drive(name, factories.problem(torch.full((2, 16, 16), 0.85)))
    assert episodes.outcome.tolist() == [Outcome.SUCCESS] * 2


@pytest.mark.parametrize("name", ["astar_dwa", "cl_rrt"])
def test_a_planner_with_a_global_path_finds_the_gap(name: str) -> None:
    problem = problem_with_gap()
    episodes = drive(name, problem)
    assert episodes.outcome.tolist() == [Outcome.SUCCESS] * 2
    crossed = problem.traversability_at(episodes.states) <= problem.stuck_threshold
    assert crossed.float().mean() < 0.02


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_same_episode(name: str) -> None:
    first, second = (drive(name, problem_with_gap()) for _ in range(2))
    assert torch.equal(first.states, second.states)
    assert torch.equal(first.actions, second.actions)


@pytest.mark.parametrize("name", NAMES)
def test_planning_is_pure(name: str) -> None:
    problem = problem_with_gap()
    made = make_planner(name, OPTIONS.get(name))
    plan_state = made.init(problem, generator())
    state = problem.start
    for _ in range(3):
        before = copies(problem), copies(plan_state), state.clone()
        action, following, plan = made.plan(state, plan_state)
        again, _, _ = made.plan(state, plan_state)
        assert torch.equal(action, again)
        for kept, value in zip(before[:2], (problem, plan_state), strict=True):
            assert all(torch.equal(kept[key], getattr(value, key)) for key in kept)
        assert torch.equal(before[2], state)
        low, high = (torch.tensor(b) for b in (problem.dynamics.action_low, problem.dynamics.action_high))
        assert ((action >= low - 1e-6) & (action <= high + 1e-6)).all()
        check_plan(plan, len(problem))
        state = problem.dynamics(state, action, problem.traversability_at(state))
        plan_state = following


def check_plan(plan: Plan, batch: int) -> None:
    assert plan.status.shape == (batch,)
    assert plan.path.shape[::2] == (batch, 2)
    assert plan.reference.shape[::2] == (batch, 2)
    assert (plan.samples.shape[0], plan.samples.shape[3], plan.samples.ndim) == (batch, 2, 4)
    assert (plan.tree.shape[0], plan.tree.shape[3], plan.tree.ndim) == (batch, 2, 4)


@pytest.mark.parametrize("name", ["astar_dwa", "cl_rrt"])
def test_no_way_is_a_status_and_ends_the_episode(name: str) -> None:
    walled = torch.full((2, 16, 16), 0.85)
    walled[0, 7:9] = 0.1
    episodes = drive(name, factories.problem(walled))
    assert episodes.outcome.tolist() == [Outcome.PLANNER_FAILURE, Outcome.SUCCESS]


def test_names_and_options_are_checked() -> None:
    assert NAMES == ["astar_dwa", "cl_rrt", "mppi"]
    with pytest.raises(ConfigError, match="Did you mean 'mppi'"):
        make_planner("mpi")
    with pytest.raises(ConfigError, match="Did you mean 'samples'"):
        make_planner("mppi", {"sample": 3})
    with pytest.raises(ConfigError, match="samples"):
        make_planner("mppi", {"samples": "many"})
    with pytest.raises(ConfigError, match="samples"):
        make_planner("mppi", {"samples": 0})


def test_a_users_planner_is_found_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    class Straight:
        def init(self, problem: Problem, generator: torch.Generator) -> None:
            return None

        def plan(self, state: torch.Tensor, plan_state: None):  # type: ignore[no-untyped-def]
            return torch.tensor([[1.0, 0.0]]).expand(len(state), 2), None, Plan.empty(len(state))

    monkeypatch.setattr(planner, "_FACTORIES", {})
    register("straight", lambda options: Straight())
    assert "straight" in planner_names()
    episodes = drive("straight", factories.problem(torch.full((1, 16, 16), 0.85)))
    assert episodes.outcome.tolist() == [Outcome.SUCCESS]
    assert PlanStatus.OK == 0
