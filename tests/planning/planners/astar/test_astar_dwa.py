"""A*+DWA in closed loops, from places in which it once stood for ever."""

import math
from dataclasses import replace

import pytest
import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.planning.free_space import FreeSpace, Rules
from benchnav.planning.objective import GoalDistance, Objective, TravelTime
from benchnav.planning.planners.astar.astar_dwa import AStarDWA, AStarDWAConfig
from benchnav.planning.planners.astar.dwa import DWAConfig
from benchnav.planning.planners.planner import check_steers
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Bicycle, DifferentialDrive, Unicycle
from benchnav.planning.world.outcome import Outcome
from tests import factories
from tests.planning.planners.driving import Drive, drive, first, generator

SUCCESS = Outcome.SUCCESS


def longest_stand_s(driven: Drive) -> float:
    """The longest time in which a robot moved under 5 cm, over the batch."""
    longest = 0
    for states, steps in zip(driven.states, driven.steps.tolist(), strict=True):
        since = 0
        for step in range(steps):
            if (states[step, :2] - states[since, :2]).norm() > 0.05:
                since = step
            longest = max(longest, step - since)
    return longest / 10


@pytest.mark.parametrize(
    ("robot", "objective"),
    [
        (Unicycle(), GoalDistance()),
        (DifferentialDrive(), TravelTime(DifferentialDrive(), 1.0)),
    ],
)
def test_it_finds_the_gap_in_a_wall(robot: Unicycle, objective: Objective) -> None:
    ground = torch.full((2, 24, 30), 0.85)
    ground[:, 11:13, :] = 0.1
    ground[:, 11:13, 20:24] = 0.85
    problem = factories.problem(ground, (3.0, 2.5), (6.0, 10.0), robot, objective)
    driven = drive(AStarDWA(), problem)
    assert driven.outcome.tolist() == [SUCCESS] * 2
    assert problem.free_at(driven.states).float().mean() > 0.98


def cornered(objective: Objective) -> Problem:
    """Four corners of ground that is not free, to be passed closely on either side and
    both axes.
    """
    ground = torch.full((4, 20, 26), 0.8)
    ground[0, 6:, 8:12] = 0.0
    ground[1, :12, 8:12] = 0.0
    ground[2, 4:14, 6:20] = 0.0
    # A way that leads through corners alone.
    ground[3, :, 12] = 0.0
    ground[3, 8, 12], ground[3, 7:10, 11], ground[3, 8, 11] = 0.8, 0.0, 0.8
    return factories.problem(
        ground, start=(2.0, 4.0), goal=(11.5, 4.2), objective=objective
    )


@pytest.mark.parametrize("objective", [GoalDistance(), TravelTime(Unicycle(), 1.0)])
def test_it_does_not_stand_beside_a_corner(objective: Objective) -> None:
    driven = drive(AStarDWA(), cornered(objective))
    assert driven.outcome.tolist() == [SUCCESS] * 4
    assert longest_stand_s(driven) < 5


def test_it_sets_off_however_near_to_a_corner_it_stands() -> None:
    # Beside it, at its tip, and in the cell before it; looking along each axis.
    places = ((3.98, 3.6), (3.99, 2.99), (3.7, 2.6))
    starts = torch.tensor(
        [[*place, heading] for place in places for heading in (0.0, 1.5, 3.1, -2.0)]
    )
    ground = torch.full((len(starts), 16, 20), 0.8)
    ground[:, 6:, 8:12] = 0.0
    problem = replace(factories.problem(ground, goal=(8.5, 6.5)), start=starts)
    driven = drive(AStarDWA(), problem)
    assert driven.outcome.tolist() == [SUCCESS] * len(starts)
    assert longest_stand_s(driven) < 8


def test_it_leaves_ground_that_is_predicted_to_hold_it() -> None:
    predicted = torch.full((2, 16, 20), 0.8)
    predicted[:, 1:6, 1:6] = 0.0
    truth = predicted.clone()
    truth[:, 1:6, 1:6] = 0.4
    problem = factories.problem(predicted, goal=(8.5, 6.5))
    problem = replace(problem, start=torch.tensor([[1.7, 1.6, 0.8], [1.7, 1.6, -2.4]]))
    driven = drive(AStarDWA(), problem, truth)
    assert driven.outcome.tolist() == [SUCCESS] * 2
    assert driven.steps.max() < 350


@pytest.mark.parametrize("objective", [GoalDistance(), TravelTime(Unicycle(), 1.0)])
def test_it_drives_across_where_no_way_is_free(objective: Objective) -> None:
    # A wall of 1.5 m across the map, either way, and a goal in a closed corner.
    ground = torch.full((3, 16, 20), 0.85)
    ground[0, 7:10] = 0.1
    ground[1, :, 9:12] = 0.1
    ground[2, 9:, 12:] = 0.2
    problem = factories.problem(ground, goal=(8.5, 6.5), objective=objective)
    driven = drive(AStarDWA(), problem, ground.clamp(min=0.4))
    assert driven.outcome.tolist() == [SUCCESS] * 3


def test_a_robot_turned_away_turns_round() -> None:
    problem = factories.problem(
        torch.full((3, 16, 20), 0.6), start=(4.0, 4.0), goal=(8.0, 4.0)
    )
    starts = torch.tensor([[4.0, 4.0, math.pi], [4.0, 4.0, 2.0], [4.0, 4.0, -2.0]])
    driven = drive(AStarDWA(), replace(problem, start=starts))
    assert driven.outcome.tolist() == [SUCCESS] * 3
    assert driven.steps.max() < 200


@pytest.mark.parametrize("rate", [-1.0, 1.0])
def test_a_robot_that_spins_stops_it(rate: float) -> None:
    problem = factories.problem(
        torch.full((1, 16, 20), 0.6), start=(4.0, 4.0), goal=(8.0, 4.0)
    )
    planner = AStarDWA()
    state = planner.init(problem, generator())
    spinning = torch.tensor([[0.0, rate]])
    state = replace(state, local=planner.local.commit_action(state.local, spinning))
    robot_state, rates = problem.start, []
    for _ in range(150):
        step = replace(first(problem), state=robot_state)
        action, state, _ = planner.plan(step, state)
        robot_state = problem.robot(
            robot_state, action, problem.traversability_at(robot_state)
        )
        rates.append(action[0, 1].item())
        if (robot_state[0, :2] - problem.goal_m[0]).norm() < 1:
            break
    else:
        pytest.fail("it did not arrive")
    assert abs(rates[-1]) < 0.3


def test_its_settings_are_its_own_and_those_of_dwa() -> None:
    part = {"part": "astar_dwa", "options": {"lookahead_m": 3, "dwa": {"horizon_s": 4}}}
    made = registry.make("planner", part)
    assert made.config == AStarDWAConfig(lookahead_m=3.0, dwa=DWAConfig(horizon_s=4.0))
    assert made.local.config == DWAConfig(horizon_s=4.0)
    with pytest.raises(ConfigError, match="dwa"):
        registry.make(
            "planner", {"part": "astar_dwa", "options": {"dwa": {"horizons": 40}}}
        )


class Own(GoalDistance):
    """An objective whose path cost is its own."""

    def __init__(self, power: float) -> None:
        self.power = power

    def path_cost(
        self, traversability: torch.Tensor, grade: torch.Tensor
    ) -> torch.Tensor:
        return 2 * traversability**-self.power


class Bare(Objective):
    """An objective without a path cost."""

    stage, terminal = GoalDistance.stage, GoalDistance.terminal


@pytest.mark.parametrize("by", ["mean", "risk"])
def test_it_tells_where_no_risk_setting_moves_its_path(by: str) -> None:
    rules = Rules(free_space=FreeSpace(by=by))
    for objective, moves in (
        (GoalDistance(), False), (TravelTime(Unicycle(), 1.0), True), (Own(0.0), False), (Own(0.5), True)
    ):  # fmt: skip
        remarks = AStarDWA().remarks(factories.task(objective=objective, rules=rules))
        if moves or by == "risk":
            assert remarks == ()
        else:
            (remark,) = remarks
            assert "travel_time" in remark
            assert "affects only DWA" in remark


def test_it_tells_that_it_takes_the_shortest_path_of_an_objective_without_its_own_cost() -> (
    None
):
    (remark,) = AStarDWA().remarks(factories.task(objective=Bare()))
    assert "shortest" in remark
    assert "Bare" in remark
    by_mean = Rules(free_space=FreeSpace(by="mean"))
    assert len(AStarDWA().remarks(factories.task(objective=Bare(), rules=by_mean))) == 2


def test_it_refuses_a_robot_that_steers() -> None:
    check_steers(AStarDWA(), DifferentialDrive(), "astar_dwa")
    with pytest.raises(ConfigError, match="steering_rad"):
        check_steers(AStarDWA(), Bicycle(), "astar_dwa")
