from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from benchnav.eval.run import rollout
from benchnav.planning.planners.planner import Plan, Planner
from benchnav.planning.planners.straight import steer_toward
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.simulation import Simulation, end
from benchnav.planning.world.world import World
from tests import factories

BATCH = 2


class Clock:
    """Time that passes only where a planner says so."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now


class Slow(Planner[int]):
    """Stands still; takes 5 s to begin, and 1 s for its first step, 2 s for its second
    and so on.
    """

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
    monkeypatch.setattr(
        rollout, "time", SimpleNamespace(perf_counter=clock.perf_counter)
    )
    ground, world = torch.full((BATCH, 16, 16), 0.8), World(time_budget_s=0.4)
    problem = factories.problem(ground, time_budget_s=0.4)
    goal = torch.tensor([[6.75, 6.75]] * BATCH)
    simulation = Simulation(
        factories.terrain(ground),
        factories.task(),
        world,
        factories.places(goal),
        0,
        range(BATCH),
    )
    return rollout.run_episodes(
        Slow(clock, **options), problem, simulation, torch.Generator()
    )


def test_wall_time_is_told_of_the_beginning_and_of_each_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    episodes = run(monkeypatch)
    assert episodes.begin_s == 5
    assert episodes.planning_s.tolist() == [1, 2, 3, 4]
    assert episodes.actions.shape[1] == 4


def test_a_plan_that_was_never_made_has_no_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    episodes = run(monkeypatch, raises_at=3)
    assert episodes.planning_s.tolist() == [1, 2]
    assert episodes.errors == ("RuntimeError: enough",) * BATCH


class Watch(Planner[None]):
    """Stands still and notes what time it is told."""

    def __init__(self) -> None:
        self.told: list[float] = []

    def init(self, problem: Problem, generator: torch.Generator) -> None:
        return None

    def plan(self, step: Step, plan_state: None) -> Any:
        self.told.append(step.time_s)
        return torch.zeros(BATCH, 2), plan_state, Plan.empty(BATCH)


@pytest.mark.parametrize("dt_s", [0.1, 0.25])
def test_a_planner_is_told_the_time_by_the_steps_of_its_robot(dt_s: float) -> None:
    ground, robot = torch.full((BATCH, 16, 16), 0.8), Unicycle(dt_s=dt_s)
    problem = factories.problem(ground, robot=robot, time_budget_s=1.0)
    goals = factories.places(torch.tensor([[6.75, 6.75]] * BATCH))
    simulation = Simulation(
        factories.terrain(ground),
        factories.task(robot),
        World(time_budget_s=1.0),
        goals,
        0,
        range(BATCH),
    )
    planner: Any = Watch()
    rollout.run_episodes(planner, problem, simulation, torch.Generator())
    assert planner.told == pytest.approx(
        [dt_s * step for step in range(round(1 / dt_s))]
    )


class Steady(Watch):
    """Commands 0.6 m/s and 0.2 rad/s."""

    def plan(self, step: Step, plan_state: None) -> Any:
        return torch.tensor([[0.6, 0.2]] * BATCH), plan_state, Plan.empty(BATCH)


def test_commanded_speed_and_turn_rate_are_those_of_undisturbed_motion() -> None:
    ground, robot = torch.full((BATCH, 16, 16), 0.5), Unicycle(dt_s=0.25)
    problem = factories.problem(ground, robot=robot, time_budget_s=1.0)
    goals = factories.places(torch.tensor([[6.75, 6.75]] * BATCH))
    simulation = Simulation(
        factories.terrain(ground),
        factories.task(robot),
        World(time_budget_s=1.0),
        goals,
        0,
        range(BATCH),
    )
    planner: Any = Steady()
    episodes = rollout.run_episodes(planner, problem, simulation, torch.Generator())
    torch.testing.assert_close(
        episodes.unhindered_speed_mps, torch.full((BATCH, 4), 0.6)
    )
    torch.testing.assert_close(
        episodes.unhindered_turn_rate_radps, torch.full((BATCH, 4), 0.2)
    )


class Breaking(Simulation):
    """Fails in the second episode, in the first step."""

    def step(self, now: Any, action: Any) -> Any:
        after, observed = super().step(now, action)
        second = torch.tensor([False, True])
        return end(after, second, Outcome.MODEL_ERROR), observed

    def faults(self, now: Any) -> list[str]:
        return ["", "the body diverged"]


def test_a_simulation_that_fails_ends_its_episode_with_a_message() -> None:
    ground = torch.full((BATCH, 16, 16), 0.5)
    problem = factories.problem(ground, time_budget_s=1.0)
    goals = factories.places(torch.tensor([[6.75, 6.75]] * BATCH))
    world = World(time_budget_s=1.0)
    simulation = Breaking(
        factories.terrain(ground), factories.task(), world, goals, 0, range(BATCH)
    )
    planner: Any = Steady()
    episodes = rollout.run_episodes(planner, problem, simulation, torch.Generator())
    assert episodes.errors == ("", "the body diverged")
    assert episodes.outcome[1] == Outcome.MODEL_ERROR
    assert episodes.steps.tolist() == [10, 1]


class Homing(Planner[Problem]):
    """Drives at the goal by what it kept of the problem; notes for which goals it was
    asked.
    """

    def __init__(self) -> None:
        self.asked: list[list[float]] = []
        self.traversability: list[list[float]] = []

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        return problem

    def plan(self, step: Step, plan_state: Problem) -> Any:
        self.asked.append(plan_state.goal_m[:, 0].tolist())
        self.traversability.append(step.traversability.tolist())
        action = steer_toward(step.state, plan_state.goal_m, plan_state.robot)
        path = plan_state.goal_m[:, None]
        return action, plan_state, Plan.empty(len(action), path=path)


class Leaving(Homing):
    """May be left by episodes that have ended."""

    def select(self, plan_state: Problem, members: torch.Tensor) -> Problem:
        return plan_state.select(members)


GOALS = torch.tensor([[7.0, 1.25], [2.5, 1.25], [3.5, 1.25], [6.0, 1.25]])


def home(
    planner: Homing, planned: list[tuple[int, list[int], list[float]]] | None = None
) -> rollout.Episodes:
    """Four robots side by side; the second and the third are there soon."""
    ground, goals = torch.full((4, 16, 16), 0.9), GOALS
    problem = factories.problem(ground, time_budget_s=40.0)
    problem = replace(problem, goal_m=goals)
    simulation = Simulation(
        factories.terrain(ground),
        factories.task(),
        World(time_budget_s=40.0),
        factories.places(goals),
        0,
        range(4),
    )

    def watch(step: int, plan: Plan, members: list[int]) -> None:
        assert planned is not None
        planned.append((step, members, plan.path[:, 0, 0].tolist()))

    observer = rollout.Observer(
        plan=None if planned is None else watch, plan_interval=5
    )
    return rollout.run_episodes(
        planner, problem, simulation, torch.Generator(), observer
    )


def test_episodes_that_have_ended_are_planned_for_no_more_and_nothing_else_changes() -> (
    None
):
    staying, leaving = Homing(), Leaving()
    whole, part = home(staying), home(leaving)
    assert {len(goals) for goals in staying.asked} == {4}
    assert leaving.asked[0] == GOALS[:, 0].tolist()
    assert leaving.asked[-1] == [7.0]
    assert part.planned.tolist() == [len(goals) for goals in leaving.asked]
    assert whole.planned.tolist() == [4] * len(staying.asked)
    for number, (goals, observed) in enumerate(
        zip(leaving.asked[1:], leaving.traversability[1:], strict=True)
    ):
        members = [GOALS[:, 0].tolist().index(goal) for goal in goals]
        assert observed == part.traversability[members, number].tolist()
    assert bool((whole.outcome == Outcome.SUCCESS).all())
    for name in ("states", "actions", "traversability", "outcome", "steps"):
        mine, other = getattr(part, name), getattr(whole, name)
        for member, count in enumerate(whole.steps.tolist()):
            own = (member, slice(count)) if mine.dim() > 1 else member
            assert torch.equal(mine[own], other[own]), name


def test_who_watches_is_told_whose_plans_they_are() -> None:
    planned: list[tuple[int, list[int], list[float]]] = []
    episodes = home(Leaving(), planned)
    assert [step for step, _, _ in planned] == list(
        range(0, episodes.actions.shape[1], 5)
    )
    for _, members, goals in planned:
        assert goals == GOALS[members, 0].tolist()
    assert planned[0][1] == [0, 1, 2, 3]
    assert planned[-1][1] == [0]


def test_a_planner_that_cannot_be_left_is_blamed() -> None:
    class Stubborn(Homing):
        def select(self, plan_state: Problem, members: torch.Tensor) -> Problem:
            raise RuntimeError("all or none")

    episodes = home(Stubborn())
    assert episodes.outcome[0] == Outcome.PLANNER_ERROR
    assert episodes.errors[0] == "RuntimeError: all or none"
    assert episodes.outcome[1] == Outcome.SUCCESS


def test_calls_are_timed_one_by_one_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter([0.0, 2.0, 10.0, 11.5])
    monkeypatch.setattr(
        rollout, "time", SimpleNamespace(perf_counter=lambda: next(ticks))
    )
    timer = rollout.Clock(torch.device("cpu"))
    for _ in range(2):
        with timer.timed():
            pass
    assert timer.seconds() == [2.0, 1.5]


def test_a_gpu_is_waited_for_once_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Events as those of a GPU, whose times are known only after it was waited for."""
    told: list[str] = []

    class Event:
        def __init__(self, enable_timing: bool) -> None:
            assert enable_timing

        def record(self) -> None:
            self.place = len(told)
            told.append("record")

        def elapsed_time(self, end: "Event") -> float:
            assert "synchronize" in told
            return 1000.0 * (end.place - self.place)

    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: told.append("synchronize"))
    timer = rollout.Clock(torch.device("cuda"))
    with timer.timed():
        told.append("work")
    with timer.timed():
        pass
    assert told == ["record", "work", "record", "record", "record"]
    assert timer.seconds() == [2.0, 1.0]


def test_what_raises_is_not_counted() -> None:
    timer = rollout.Clock(torch.device("cpu"))
    with pytest.raises(RuntimeError, match="no"), timer.timed():
        raise RuntimeError("no")
    assert timer.seconds() == []
