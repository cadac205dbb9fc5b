from dataclasses import replace

import pytest
import torch

from benchnav.core import rng
from benchnav.planning.free_space import Immobile, Rules
from benchnav.planning.robots import DifferentialDrive, Unicycle
from benchnav.planning.world.outcome import FAILURES, Outcome
from benchnav.planning.world.realisation import Realisation
from benchnav.planning.world.simulation import Simulation, SimulationState, end
from benchnav.planning.world.world import World
from tests import factories

KEY = rng.stream_key(0, "noise")
AHEAD = torch.tensor([[1.0, 0.0]])
FAR = (90.0, 90.0)


def simulation(
    mean: torch.Tensor,
    *goals: tuple[float, float],
    std: float = 0.0,
    noise: str = "resampled",
    time_budget_s: float = 100.0,
    immobile: Immobile | None = None,
    **task,  # type: ignore[no-untyped-def]
) -> Simulation:
    goal = torch.tensor(goals).expand(len(mean), 2)
    world = World(noise=noise, time_budget_s=time_budget_s, immobile=immobile)
    return Simulation(
        factories.terrain(mean, std),
        factories.task(**task),
        world,
        factories.places(goal),
        KEY,
        range(len(mean)),
    )


def even(*values: float) -> torch.Tensor:
    return torch.stack([torch.full((16, 16), value) for value in values])


def poses(*given: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(given)


def test_a_robot_moves_by_f_under_the_lambda_that_it_met() -> None:
    sim = simulation(even(0.5, 0.8), FAR, std=0.1)
    start = poses((4.0, 4.0, 0.3), (2.0, 3.0, 1.0))
    action = torch.tensor([[0.8, -0.4], [0.3, 0.9]])
    now, met = sim.step(sim.init(start), action)
    terrain, places = (
        factories.terrain(even(0.5, 0.8), 0.1),
        factories.places(torch.zeros(2, 2)),
    )
    truth = Realisation(terrain, World(), places, 1000, KEY, range(2))
    assert torch.equal(met, truth.at(start, torch.zeros(2, dtype=torch.int64)))
    assert torch.equal(now.state, Unicycle()(start, action, met))
    assert now.step.tolist() == [1, 1]
    later, again = sim.step(now, action)
    assert torch.equal(again, truth.at(now.state, torch.ones(2, dtype=torch.int64)))
    assert torch.equal(later.state, Unicycle()(now.state, action, again))


def test_the_tasks_robot_is_the_one_that_moves() -> None:
    robot = DifferentialDrive(dt_s=0.5)
    sim = simulation(even(1.0), FAR, robot=robot, time_budget_s=2.0)
    start = robot.initial_state(poses((4.0, 4.0, 0.0)))
    now, _ = sim.step(sim.init(start), AHEAD)
    assert torch.equal(now.state, robot(start, AHEAD, torch.ones(1)))
    assert sim.steps.tolist() == [4]


def test_the_worlds_noise_is_the_one_that_is_met() -> None:
    mean = torch.rand(1, 16, 16)
    _, met = (sim := simulation(mean, FAR, std=0.5, noise="stored")).step(
        sim.init(poses((3.3, 1.2, 0.0))), AHEAD
    )
    assert met[0] == mean[0, 2, 6]


def test_actions_are_clipped_to_the_bounds() -> None:
    sim = simulation(even(1.0, 1.0), FAR)
    start = poses((2.0, 4.0, 0.0), (2.0, 4.0, 0.0))
    action = torch.tensor([[50.0, -50.0], [-50.0, 50.0]])
    now, _ = sim.step(sim.init(start), action)
    assert now.state[0].tolist() == pytest.approx([2.1, 4.0, -0.1])
    assert now.state[1].tolist() == pytest.approx([2.0, 4.0, 0.1])
    assert action.abs().min() == 50
    assert torch.equal(sim.unhindered(sim.init(start), action), now.state)


def test_unhindered_is_what_was_commanded_whatever_the_ground_is() -> None:
    sim = simulation(even(0.0), FAR)
    now = sim.init(poses((2.0, 4.0, 0.0)))
    assert sim.unhindered(now, torch.tensor([[0.5, 1.0]]))[0].tolist() == pytest.approx(
        [2.05, 4.0, 0.1]
    )
    assert sim.step(now, AHEAD)[0].state[0].tolist() == [2.0, 4.0, 0.0]


def test_how_episodes_end() -> None:
    goals = (3.5, 4.0), (-5.0, 4.0), (7.0, 4.0), (0.5, 4.0)
    sim = simulation(even(1.0, 1.0, 0.0, 1.0), *goals, time_budget_s=1.2)
    now = sim.init(
        poses(
            (2.0, 4.0, 0.0),
            (0.95, 4.0, 3.1415927),
            (2.0, 4.0, 0.0),
            (0.05, 4.0, 3.1415927),
        )
    )
    assert now.outcome.tolist() == [Outcome.RUNNING] * 4
    steps = 0
    while now.running.any():
        now, _ = sim.step(now, AHEAD.expand(4, 2))
        steps += 1
    # The last leaves the map within the goal's radius: to arrive is what counts.
    assert now.outcome.tolist() == [
        Outcome.SUCCESS,
        Outcome.OUT_OF_BOUNDS,
        Outcome.TIMEOUT,
        Outcome.SUCCESS,
    ]
    assert now.step.tolist() == [6, 10, 12, 1]
    assert steps == 12


def test_arrival_in_the_last_step_is_a_success() -> None:
    sim = simulation(even(1.0), (3.55, 4.0), time_budget_s=0.6)
    now = sim.init(poses((2.0, 4.0, 0.0)))
    for _ in range(6):
        now, _ = sim.step(now, AHEAD)
    assert now.outcome.tolist() == [Outcome.SUCCESS]
    assert now.step.tolist() == [6]


def test_the_goal_radius_of_the_rules_counts() -> None:
    sim = simulation(even(1.0), (3.5, 4.0), rules=Rules(goal_radius_m=0.55))
    now = sim.init(poses((2.0, 4.0, 0.0)))
    while now.running.any():
        now, _ = sim.step(now, AHEAD)
    assert now.step.tolist() == [10]


def test_an_ended_episode_stands_still() -> None:
    sim = simulation(even(1.0, 1.0), (2.5, 4.0))
    now, _ = sim.step(
        sim.init(poses((2.0, 4.0, 0.0), (5.0, 4.0, 0.0))), AHEAD.expand(2, 2)
    )
    assert now.outcome.tolist() == [Outcome.SUCCESS, Outcome.RUNNING]
    later, _ = sim.step(now, AHEAD.expand(2, 2))
    assert torch.equal(later.state[0], now.state[0])
    assert not torch.equal(later.state[1], now.state[1])
    assert later.step.tolist() == [1, 2]


def test_an_outcome_that_the_simulation_cannot_see_ends_only_running_episodes() -> None:
    outcome = torch.tensor([Outcome.SUCCESS, Outcome.RUNNING, Outcome.RUNNING])
    now = SimulationState(
        torch.zeros(3, 3),
        outcome,
        torch.tensor([4, 5, 6]),
        torch.zeros(3, dtype=torch.int64),
    )
    ended = end(now, torch.tensor([True, True, False]), Outcome.PLANNER_ERROR)
    assert ended.outcome.tolist() == [
        Outcome.SUCCESS,
        Outcome.PLANNER_ERROR,
        Outcome.RUNNING,
    ]
    assert ended.running.tolist() == [False, False, True]
    assert now.outcome.tolist() == [Outcome.SUCCESS, Outcome.RUNNING, Outcome.RUNNING]
    assert torch.equal(ended.step, now.step)


def test_the_start_is_kept_apart_from_the_state() -> None:
    start = poses((2.0, 4.0, 0.0))
    now = simulation(even(1.0), FAR).init(start)
    start.zero_()
    assert now.state[0].tolist() == [2.0, 4.0, 0.0]


def test_some_episodes_are_exchanged_with_their_goals() -> None:
    sim = simulation(even(1.0, 1.0), (2.5, 4.0))
    other = simulation(even(0.0), FAR)
    sim.exchange_(torch.tensor([1]), other)
    start = poses((2.0, 4.0, 0.0), (2.0, 4.0, 0.0))
    now, met = sim.step(sim.init(start), AHEAD.expand(2, 2))
    assert met.tolist() == [1, 0]
    assert now.outcome.tolist() == [Outcome.SUCCESS, Outcome.RUNNING]


def test_every_outcome_but_success_and_running_is_a_failure() -> None:
    assert {outcome.name for outcome in FAILURES} == {
        "TIMEOUT", "STUCK", "STALLED", "OUT_OF_BOUNDS", "PLANNER_FAILURE", "PLANNER_ERROR", "MODEL_ERROR",
        "IMMOBILISED", "SENSOR_ERROR", "BELIEF_ERROR", "ROLLOVER",
    }  # fmt: skip


def held_after(
    sim: Simulation, *rows: tuple[float, float, float], speed: float = 1.0
) -> SimulationState:
    now = sim.init(poses(*rows))
    while now.running.any():
        now, _ = sim.step(now, torch.tensor([[speed, 0.0]]).expand(len(rows), 2))
    return now


def test_ground_under_the_bound_ends_an_episode_after_its_time_and_other_ground_does_not() -> (
    None
):
    immobile = Immobile(below=0.1, for_s=0.5)
    now = held_after(
        simulation(even(0.099, 0.1), FAR, time_budget_s=2.0, immobile=immobile),
        *[(4.0, 4.0, 0.0)] * 2,
    )
    assert now.outcome.tolist() == [Outcome.IMMOBILISED, Outcome.TIMEOUT]
    assert now.step.tolist() == [5, 20]
    longer = simulation(
        even(0.099), FAR, time_budget_s=2.0, immobile=Immobile(below=0.1, for_s=1.2)
    )
    assert held_after(longer, (4.0, 4.0, 0.0)).step.tolist() == [12]
    slow = simulation(
        even(0.099),
        FAR,
        robot=Unicycle(dt_s=0.5),
        immobile=Immobile(below=0.1, for_s=2.0),
    )
    assert held_after(slow, (4.0, 4.0, 0.0)).step.tolist() == [4]
    free = simulation(even(0.0), FAR, time_budget_s=2.0)
    assert held_after(free, (4.0, 4.0, 0.0)).outcome.tolist() == [Outcome.TIMEOUT]


def test_a_robot_is_held_whatever_was_commanded() -> None:
    sim = simulation(
        even(0.05), FAR, time_budget_s=2.0, immobile=Immobile(below=0.1, for_s=0.5)
    )
    assert held_after(sim, (4.0, 4.0, 0.0), speed=0.0).outcome.tolist() == [
        Outcome.IMMOBILISED
    ]


def test_a_break_begins_the_count_anew() -> None:
    """Two soft cells of 0.5 m, each crossed in less time than immobilises a robot, with
    firm ground between.
    """
    ground = even(0.5)
    ground[:, :, [4, 6]] = 0.09
    crossing_s = 0.5 / 0.09
    for for_s, outcome in (
        (crossing_s + 1, Outcome.TIMEOUT),
        (crossing_s - 1, Outcome.IMMOBILISED),
    ):
        sim = simulation(
            ground,
            FAR,
            noise="stored",
            time_budget_s=20.0,
            immobile=Immobile(below=0.1, for_s=for_s),
        )
        assert held_after(sim, (1.9, 4.0, 0.0)).outcome.tolist() == [outcome]


def test_arriving_counts_for_more_than_being_held_and_being_held_for_more_than_the_time() -> (
    None
):
    immobile = Immobile(below=0.1, for_s=0.5)
    arriving = simulation(
        even(0.05), (4.0 + 1.0 + 0.024, 4.0), time_budget_s=9.0, immobile=immobile
    )
    assert held_after(arriving, (4.0, 4.0, 0.0)).outcome.tolist() == [Outcome.SUCCESS]
    late = simulation(even(0.05), FAR, time_budget_s=0.5, immobile=immobile)
    assert held_after(late, (4.0, 4.0, 0.0)).outcome.tolist() == [Outcome.IMMOBILISED]


def test_each_episode_has_its_own_time_budget() -> None:
    places = replace(
        factories.places(torch.full((2, 2), 90.0)),
        reference_time_s=torch.tensor([0.4, 0.8]),
    )
    world = World(time_budget_s=None, time_budget_ratio=2.0)
    sim = Simulation(
        factories.terrain(even(1.0, 1.0), 0.0),
        factories.task(),
        world,
        places,
        KEY,
        range(2),
    )
    assert sim.time_budget_s.tolist() == pytest.approx([0.8, 1.6])
    now = held_after(sim, (4.0, 4.0, 0.0), (4.0, 4.0, 0.0))
    assert now.step.tolist() == [8, 16]
    assert now.outcome.tolist() == [Outcome.TIMEOUT] * 2


def test_some_episodes_are_exchanged_with_their_time_budgets() -> None:
    def sim(ratio: float) -> Simulation:
        places = replace(
            factories.places(torch.full((2, 2), 90.0)),
            reference_time_s=torch.tensor([0.4, 0.8]),
        )
        world = World(time_budget_s=None, time_budget_ratio=ratio)
        return Simulation(
            factories.terrain(even(1.0, 1.0), 0.0),
            factories.task(),
            world,
            places,
            KEY,
            range(2),
        )

    mixed = sim(2.0)
    mixed.exchange_(torch.tensor([1, 0]), sim(4.0))
    assert mixed.steps.tolist() == [32, 16]
    assert mixed.time_budget_s.tolist() == pytest.approx([3.2, 1.6])


@pytest.mark.parametrize("noise", ["resampled", "stored", "frozen"])
def test_the_field_of_a_step_is_what_robots_meet_in_it(noise: str) -> None:
    mean = 0.2 + 0.6 * torch.rand(3, 16, 16)
    sim = simulation(mean, FAR, std=0.2, noise=noise, time_budget_s=1.0)
    row, column = torch.meshgrid(torch.arange(16), torch.arange(16), indexing="ij")
    for step in (0, 4, 9, 30):
        field = sim.field_at(step)
        assert field.shape == (3, 16, 16)
        for own in range(0, 256, 37):
            at = poses(
                *[
                    (
                        0.5 * column.flatten()[own].item() + 0.2,
                        0.5 * row.flatten()[own].item() + 0.4,
                        0.0,
                    )
                ]
                * 3
            )
            now = SimulationState(
                at,
                torch.zeros(3, dtype=torch.int64),
                torch.full((3,), step),
                torch.zeros(3, dtype=torch.int64),
            )
            _, met = sim.step(now, AHEAD.expand(3, 2))
            torch.testing.assert_close(
                met, field[:, row.flatten()[own], column.flatten()[own]]
            )
    assert torch.equal(sim.field_at(4), sim.field_at(9)) == (noise != "resampled")
    if noise != "resampled":
        assert torch.equal(sim.field_at(7), sim.field)


def test_fields_of_exchanged_episodes_are_those_of_the_others() -> None:
    sim, other = (
        simulation(torch.rand(2, 16, 16), FAR, std=0.2, noise="resampled")
        for _ in range(2)
    )
    before, new = sim.field_at(3), other.field_at(3)
    sim.exchange_(torch.tensor([1, 0]), other)
    torch.testing.assert_close(sim.field_at(3), new[[1, 0]])
    assert not torch.equal(sim.field_at(3), before)
