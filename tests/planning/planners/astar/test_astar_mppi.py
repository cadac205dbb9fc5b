import pytest
import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.planning.objective import GoalDistance, Objective, TravelTime
from benchnav.planning.planners.astar.astar_dwa import AStarDWA
from benchnav.planning.planners.astar.astar_mppi import AStarMPPI, AStarMPPIConfig
from benchnav.planning.planners.mppi import MPPI
from benchnav.planning.planners.mppi_config import MPPIConfig
from benchnav.planning.planners.planner import check_steers
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Bicycle, DifferentialDrive, Unicycle
from benchnav.planning.world.outcome import Outcome
from tests import factories
from tests.planning.planners.driving import drive, first, generator

SMALL = MPPIConfig(samples=256, horizon_s=3)


def trap(robot: Unicycle | Bicycle) -> Problem:
    """A pocket of ground that is not free, open toward the start, between it and the
    goal.
    """
    ground = torch.full((2, 24, 24), 0.85)
    ground[:, 8:16, 14:16] = 0.1
    ground[:, 8:10, 8:16] = ground[:, 14:16, 8:16] = 0.1
    return factories.problem(ground, start=(2.75, 6.0), goal=(10.0, 6.0), robot=robot)


@pytest.mark.parametrize("robot", [Unicycle(), DifferentialDrive(), Bicycle()])
def test_the_global_path_leads_it_round_a_pocket(robot: Unicycle | Bicycle) -> None:
    problem = trap(robot)
    driven = drive(AStarMPPI(AStarMPPIConfig(mppi=SMALL)), problem, time_budget_s=50)
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * 2
    assert problem.free_at(driven.states).float().mean() > 0.98


@pytest.mark.parametrize("objective", [GoalDistance(), TravelTime(Unicycle(), 1.0)])
def test_it_drives_across_a_wall_that_closes_the_map(objective: Objective) -> None:
    # Ground 1.5 m thick that is not free, from one edge of the map to the other; it
    # carries the robot slowly.
    ground = torch.full((2, 20, 20), 0.85)
    ground[0, :, 9:12] = 0.1
    ground[1, 9:12] = 0.1
    problem = factories.problem(ground, (2.75, 3.0), (8.5, 8.0), objective=objective)
    driven = drive(
        AStarMPPI(AStarMPPIConfig(mppi=SMALL)), problem, ground.clamp(min=0.4), 60
    )
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * 2


def test_mppi_alone_stays_in_the_pocket() -> None:
    driven = drive(MPPI(SMALL), trap(Unicycle()), time_budget_s=30)
    assert Outcome.SUCCESS not in driven.outcome.tolist()


def test_it_is_given_the_way_points_that_dwa_is_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = trap(Unicycle())
    told: list[torch.Tensor] = []
    for planner in (AStarMPPI(AStarMPPIConfig(mppi=SMALL)), AStarDWA()):
        local = planner.local
        plan_toward = local.plan_toward

        def spy(step, state, target, plan_toward=plan_toward):  # type: ignore[no-untyped-def]
            told.append(target)
            return plan_toward(step, state, target)

        monkeypatch.setattr(local, "plan_toward", spy)
        planner.plan(first(problem), planner.init(problem, generator()))
    assert torch.equal(told[0], told[1])
    assert not torch.equal(told[0], problem.goal_m)


def test_its_settings_are_its_own_and_those_of_mppi() -> None:
    part = {
        "part": "astar_mppi",
        "options": {"lookahead_m": 3, "mppi": {"samples": 300, "noise": [0.4, 0.3]}},
    }
    made = registry.make("planner", part)
    assert made.config == AStarMPPIConfig(
        lookahead_m=3.0, mppi=MPPIConfig(samples=300, noise=(0.4, 0.3))
    )
    assert made.local.config.samples == 300
    with pytest.raises(ConfigError, match="lookahead_m"):
        registry.make(
            "planner", {"part": "astar_mppi", "options": {"lookahead_m": 0.0}}
        )


def test_it_says_whether_it_runs_compiled() -> None:
    planner = AStarMPPI(AStarMPPIConfig(mppi=SMALL))
    assert planner.compiled is None
    problem = factories.problem(torch.full((1, 16, 16), 0.8))
    planner.plan(first(problem), planner.init(problem, generator()))
    assert planner.compiled is False


def test_it_refuses_robots_that_the_recovery_cannot_steer() -> None:
    class Legged(Unicycle):
        @property
        def action_names(self) -> tuple[str, ...]:
            return ("gait", "step_m")

    check_steers(AStarMPPI(), Bicycle(), "astar_mppi")
    with pytest.raises(ConfigError, match="gait"):
        check_steers(AStarMPPI(), Legged(), "astar_mppi")
