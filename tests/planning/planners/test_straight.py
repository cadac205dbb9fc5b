import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchnav.core.errors import ConfigError
from benchnav.planning.planners.planner import Plan, Planner, check_steers
from benchnav.planning.planners.straight import Straight, steer_toward
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Bicycle, DifferentialDrive, Unicycle
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.outcome import Outcome
from tests import factories
from tests.planning.planners.driving import drive, first, generator

UNICYCLE, BICYCLE = Unicycle(), Bicycle()
angles = st.floats(-10, 10)


def steered(heading: float, x: float, y: float, robot=UNICYCLE) -> list[float]:  # type: ignore[no-untyped-def]
    return steer_toward(
        torch.tensor([[1.0, 2.0, heading]]), torch.tensor([[x, y]]), robot
    )[0].tolist()


def test_it_drives_at_full_speed_at_what_it_looks_at() -> None:
    assert steered(0.0, 5.0, 2.0) == pytest.approx([1.0, 0.0])
    assert steered(math.pi / 2, 1.0, 5.0) == pytest.approx([1.0, 0.0], abs=1e-6)
    assert steered(0.0, 5.0, 2.0, Unicycle(speed_mps=(0, 2))) == pytest.approx(
        [2.0, 0.0]
    )


def test_it_turns_to_the_nearer_side_and_slows() -> None:
    speed, turn = steered(0.0, 2.0, 3.0)
    assert speed == 0.0
    assert turn == 1.0
    speed, turn = steered(0.0, 1 + math.cos(0.05), 2 + math.sin(0.05))
    assert speed == pytest.approx(0.75)
    assert turn == pytest.approx(0.2)
    assert steered(0.0, 2.0, 1.0)[1] == -1.0
    assert steered(0.0, -5.0, 2.5)[0] == 0.0
    # From 3.0 to −3.0 the shorter way leads over π.
    assert steered(3.0, 1 + math.cos(-3.0), 2 + math.sin(-3.0))[1] > 0


def test_it_slows_at_the_target() -> None:
    assert steered(0.0, 1.1, 2.0)[0] == pytest.approx(0.2)
    assert steered(0.0, 1.6, 2.0)[0] == 1.0


@pytest.mark.parametrize("limit", [0.4, 1.0])
def test_a_robot_of_limited_acceleration_does_not_turn_too_far(limit: float) -> None:
    robot = DifferentialDrive(turn_acceleration_radps2=limit)
    state = robot.initial_state(torch.tensor([[0.0, 0.0, 0.0]]))
    target = torch.tensor([[-30.0, 40.0]])
    for _ in range(100):
        state = robot(state, steer_toward(state, target, robot), torch.ones(1))
        assert state[0, 2] < math.atan2(40 - state[0, 1], -30 - state[0, 0]) + 0.1
    assert (state[0, :2] - target[0]).norm() < 48


def test_a_robot_that_steers_drives_while_it_turns() -> None:
    speed, steering = steered(0.0, -5.0, 2.5, BICYCLE)
    assert speed == pytest.approx(0.3)
    assert steering == pytest.approx(0.6)


@given(heading=angles, x=angles, y=angles)
@settings(max_examples=60, deadline=None)
def test_actions_keep_the_bounds_and_a_whole_turn_changes_nothing(
    heading: float, x: float, y: float
) -> None:
    for robot in (UNICYCLE, BICYCLE):
        speed, turn = steered(heading, x, y, robot)
        assert robot.action_low[0] <= speed <= robot.action_high[0]
        assert robot.action_low[1] - 1e-6 <= turn <= robot.action_high[1] + 1e-6
        if abs(math.hypot(x - 1, y - 2)) > 0.1 and abs(turn) < 0.5:
            assert steered(heading + 2 * math.pi, x, y, robot)[1] == pytest.approx(
                turn, abs=1e-3
            )


@pytest.mark.parametrize("robot", [UNICYCLE, DifferentialDrive(), BICYCLE])
def test_it_arrives_however_it_looked_at_first(robot) -> None:  # type: ignore[no-untyped-def]
    problem = factories.problem(
        torch.full((4, 24, 30), 0.8), (6.0, 6.0), (11.0, 9.0), robot
    )
    start = problem.start.clone()
    start[:, 2] = torch.tensor([0.0, 2.0, 3.7, -2.0])
    driven = drive(Straight(), replace(problem, start=start), time_budget_s=40)
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * 4


def test_it_is_blind() -> None:
    maps = torch.rand(2, 16, 16, generator=generator())
    maps[1] = 0.9
    problem = factories.problem(maps)
    planner = Straight()
    action, _, plan = planner.plan(first(problem), planner.init(problem, generator()))
    assert torch.equal(action[0], action[1])
    assert plan.status.tolist() == [0, 0]
    torch.testing.assert_close(plan.path[0], torch.tensor([[1.25, 1.25], [6.75, 6.75]]))
    assert planner.blind
    assert "straight" in planner.follows(factories.task())


def test_it_drives_through_what_others_avoid() -> None:
    walled = torch.full((1, 16, 16), 0.9)
    walled[0, 7:9] = 0.2
    driven = drive(Straight(), factories.problem(walled))
    assert driven.outcome.tolist() == [Outcome.SUCCESS]


def test_it_refuses_robots_of_other_actions() -> None:
    class Legged(Unicycle):
        @property
        def action_names(self) -> tuple[str, ...]:
            return ("gait", "step_m")

    check_steers(Straight(), BICYCLE, "straight")
    with pytest.raises(ConfigError, match="gait"):
        check_steers(Straight(), Legged(), "straight")


def test_what_a_planner_minimises_is_asked_of_the_task() -> None:
    assert "straight" in Straight().follows(factories.task())


def test_what_a_planner_does_not_say_has_a_default() -> None:
    class Least(Planner[None]):
        def init(self, problem: Problem, generator: torch.Generator) -> None:
            return None

        def plan(self, step: Step, plan_state: None) -> tuple[torch.Tensor, None, Plan]:
            return torch.zeros(len(step.state), 2), None, Plan.empty(len(step.state))

    planner, task = Least(), factories.task()
    assert (planner.follows(task), planner.remarks(task), planner.compiled) == (
        "",
        (),
        None,
    )
    assert (planner.steers, planner.blind) == (None, False)
    assert planner.select(None, torch.tensor([0])) is NotImplemented
    check_steers(planner, BICYCLE, "least")


def test_a_planner_that_cannot_plan_cannot_be_made() -> None:
    class Half(Straight):
        plan = Planner.plan  # type: ignore[assignment]

    with pytest.raises(TypeError, match="plan"):
        Half()
