"""What every registered planner does in a closed loop with the simulation, with every
robot that it steers.
"""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.planning.free_space import Immobile
from benchnav.planning.planners.planner import Planner, PlanStatus, check_steers
from benchnav.planning.problem import Problem
from benchnav.planning.world.outcome import Outcome
from tests import factories
from tests.planning.planners.driving import Drive, drive

SMALL = {"samples": 256}
OPTIONS: dict[str, dict[str, Any]] = {
    "mppi": SMALL,
    "astar_mppi": {"mppi": SMALL},
    "cl_rrt": {"expansions": 200},
}
# What is given λ itself has tests of its own.
NAMES = [name for name in registry.names("planner") if name != "near_optimal"]
# MPPI looks as far as its horizon alone and `straight` not at all; the others have a
# path over the whole map.
GLOBAL = sorted(set(NAMES) - {"mppi", "straight"})
ROBOTS = registry.names("robot")


def make(planner: str) -> Any:
    return registry.make(
        "planner", {"part": planner, "options": OPTIONS.get(planner, {})}
    )


def steers(planner: str, robot: str) -> bool:
    try:
        check_steers(make(planner), registry.make("robot", robot), planner)
    except ConfigError:
        return False
    return True


STEERED = [
    (planner, robot) for planner in NAMES for robot in ROBOTS if steers(planner, robot)
]
EACH = pytest.mark.parametrize(("planner", "robot"), STEERED)
# Tests that drive far take each planner with the robot that is hardest to turn.
HARDEST = [next(pair for pair in STEERED if pair[0] == name) for name in NAMES]
FEW = pytest.mark.parametrize(("planner", "robot"), HARDEST)
FEW_GLOBAL = pytest.mark.parametrize(
    ("planner", "robot"), [pair for pair in HARDEST if pair[0] in GLOBAL]
)


class Watched(Planner[Any]):
    """A planner whose statuses are kept."""

    def __init__(self, planner: Any) -> None:
        self.planner, self.statuses = planner, set[int]()

    def init(self, problem: Problem, generator: torch.Generator) -> Any:
        return self.planner.init(problem, generator)

    def plan(self, step: Any, plan_state: Any) -> Any:
        said = self.planner.plan(step, plan_state)
        self.statuses |= set(said[2].status.tolist())
        return said


def run(
    planner: str,
    robot: str,
    predicted: Tensor,
    truth: Tensor | None = None,
    time_budget_s: float = 60.0,
    **places: Any,
) -> Drive:
    """Drives, and asserts that the planner never gave up."""
    problem = factories.problem(
        predicted, robot=registry.make("robot", robot), **places
    )
    watched = Watched(make(planner))
    driven = drive(watched, problem, truth, time_budget_s)
    assert PlanStatus.FAILED not in watched.statuses
    return driven


def gap() -> Tensor:
    """Two maps with a wall across, with a gap of 2 m at other ends of it; not square."""
    ground = torch.full((2, 24, 30), 0.85)
    ground[:, 11:13, :] = 0.1
    ground[0, 11:13, 19:23] = 0.85
    ground[1, 11:13, 5:9] = 0.85
    return ground


def crossed(driven: Drive, predicted: Tensor) -> float:
    """Share of the steps on ground that is predicted not to be free."""
    grid = factories.problem(predicted).grid
    states = driven.states
    ground = grid.lookup(grid.pad(predicted, 0.0), states[..., 0], states[..., 1])
    under_way = torch.arange(states.shape[1]) <= driven.steps[:, None]
    return float((ground <= 0.3)[under_way].float().mean())


@EACH
def test_it_drives_to_the_goal_over_free_ground(planner: str, robot: str) -> None:
    driven = run(planner, robot, torch.full((2, 16, 20), 0.85), goal=(8.25, 6.25))
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * 2
    # The way is 8.6 m less 1 m of goal radius, at 0.85 m/s; no planner takes the double
    # of it.
    assert (driven.steps < 180).all()


@FEW_GLOBAL
def test_a_planner_with_a_global_path_finds_the_gap(planner: str, robot: str) -> None:
    ground = gap()
    driven = run(planner, robot, ground, start=(7.0, 2.5), goal=(7.5, 10.0))
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * 2
    assert crossed(driven, ground) < 0.02
    # Through the gap of its own map.
    middle = driven.states[..., 1].sub(6.0).abs().argmin(dim=1)
    x = driven.states[torch.arange(2), middle, 0]
    assert 9.0 < x[0] < 12.0
    assert 2.0 < x[1] < 5.0


@FEW
def test_from_ground_that_is_predicted_to_hold_it_it_gets_out(
    planner: str, robot: str
) -> None:
    predicted = torch.full((2, 16, 16), 0.85)
    predicted[:, 1:4, 1:4] = 0.0
    driven = run(planner, robot, predicted, torch.full_like(predicted, 0.6))
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * 2


@FEW
def test_a_closed_wall_that_can_be_passed_in_truth_is_crossed(
    planner: str, robot: str
) -> None:
    predicted = torch.full((2, 20, 17), 0.85)
    predicted[:, 9:12] = 0.0  # 1.5 m
    truth = torch.full_like(predicted, 0.7)
    # Head on: a bicycle, which needs room to turn, may leave the map where it comes
    # upon a wall aslant.
    places = {"start": (4.1, 1.25), "goal": (4.1, 8.75)}
    if planner == "mppi":
        # The penalty of crossing lies within its horizon and what is won by it beyond:
        # it waits before the wall.
        driven = run(planner, robot, predicted, truth, time_budget_s=12.0, **places)
        assert driven.outcome.tolist() == [Outcome.TIMEOUT] * 2
    else:
        driven = run(planner, robot, predicted, truth, **places)
        assert driven.outcome.tolist() == [Outcome.SUCCESS] * 2


@pytest.mark.parametrize("planner", registry.names("planner"))
def test_on_ground_that_carries_no_robot_all_are_immobilised_alike(
    planner: str,
) -> None:
    ground, immobile = torch.zeros(2, 16, 16), Immobile(below=0.3, for_s=1.5)
    problem = factories.problem(ground, start=(1.75, 3.75), goal=(6.25, 3.75))
    problem = replace(
        problem, distribution=factories.certain(ground), immobile=immobile
    )
    watched = Watched(make(planner))
    driven = drive(watched, problem, time_budget_s=20.0, immobile=immobile)
    assert driven.outcome.tolist() == [Outcome.IMMOBILISED] * 2
    assert driven.steps.tolist() == [15, 15]
    assert PlanStatus.FAILED not in watched.statuses


@FEW
def test_the_same_seed_gives_the_same_episode(planner: str, robot: str) -> None:
    ground = torch.full((2, 16, 16), 0.85)
    first, second = (run(planner, robot, ground, time_budget_s=1.5) for _ in range(2))
    assert torch.equal(first.states, second.states)
    assert torch.equal(first.actions, second.actions)


def test_every_planner_steers_the_papers_robot_and_refuses_what_it_does_not_steer() -> (
    None
):
    for planner in NAMES:
        assert (planner, "unicycle") in STEERED
        for robot in ROBOTS:
            if (planner, robot) not in STEERED:
                steered = (
                    "turns only while it drives"
                    if (planner, robot) == ("cl_rrt", "bicycle")
                    else ""
                )
                with pytest.raises(
                    ConfigError, match=f"for planner '{planner}'.*{steered}"
                ):
                    check_steers(make(planner), registry.make("robot", robot), planner)
            else:
                check_steers(make(planner), registry.make("robot", robot), planner)
