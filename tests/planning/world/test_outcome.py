import math

import pytest
import torch

from benchnav.planning.objective import distance
from benchnav.planning.world.outcome import (
    STUCK_DISTANCE_M,
    Outcome,
    classify_standstill,
)
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import World
from tests import factories

DT_S = 0.1


def tell(
    moved_mps: list[float],
    drove_mps: list[float],
    outcome: Outcome = Outcome.TIMEOUT,
    dt_s: float = DT_S,
) -> Outcome:
    """The outcome of an episode of these speeds over ground and as commanded, a value a
    step.
    """
    moved, drove = (
        dt_s * torch.tensor([speeds], dtype=torch.float64)
        for speeds in (moved_mps, drove_mps)
    )
    x = torch.nn.functional.pad(moved.cumsum(dim=1), (1, 0))
    positions = torch.stack((2 + x, torch.full_like(x, 3.0)), dim=2)
    steps = torch.tensor([len(moved_mps)])
    return Outcome(
        int(
            classify_standstill(torch.tensor([outcome]), steps, positions, drove, dt_s)[
                0
            ]
        )
    )


def test_a_robot_that_drove_and_did_not_move_is_stuck_and_one_that_did_not_drive_is_stalled() -> (
    None
):
    assert tell([0.0] * 300, [1.0] * 300) == Outcome.STUCK
    assert tell([0.0] * 300, [0.0] * 300) == Outcome.STALLED
    assert tell([0.3] * 300, [1.0] * 300) == Outcome.TIMEOUT


def test_the_last_ten_seconds_count_alone() -> None:
    before, after = 200, 100
    assert tell([1.0] * before + [0.0] * after, [1.0] * 300) == Outcome.STUCK
    assert (
        tell([1.0] * before + [0.0] * after, [1.0] * before + [0.0] * after)
        == Outcome.STALLED
    )
    assert tell([0.0] * before + [0.1] * after, [1.0] * 300) == Outcome.TIMEOUT
    # A step of driving before the last 10 s is not of them, but the first of them is.
    big = STUCK_DISTANCE_M / DT_S + 0.1
    assert tell([0.0] * 300, [0.0] * 199 + [big] + [0.0] * 100) == Outcome.STALLED
    assert tell([0.0] * 300, [0.0] * 200 + [big] + [0.0] * 99) == Outcome.STUCK
    assert tell([0.0] * 199 + [big] + [0.0] * 100, [1.0] * 300) == Outcome.STUCK
    assert tell([0.0] * 200 + [big] + [0.0] * 99, [1.0] * 300) == Outcome.TIMEOUT


@pytest.mark.parametrize("dt_s", [0.1, 0.5, 2.0, 30.0])
def test_the_window_is_in_seconds(dt_s: float) -> None:
    steps = max(1, round(10 / dt_s))
    still = [0.0] * steps
    assert tell([1.0] * 5 + still, [1.0] * 5 + still, dt_s=dt_s) == Outcome.STALLED
    assert (
        tell([1.0] * 5 + still, [1.0] * 5 + [0.0] * (steps - 1) + [1 / dt_s], dt_s=dt_s)
        == Outcome.STUCK
    )


def test_the_distances_are_half_a_metre() -> None:
    for moved, drove, outcome in (
        (0.049, 0.049, Outcome.STALLED),
        (0.049, 0.051, Outcome.STUCK),
        (0.051, 0.051, Outcome.TIMEOUT),
    ):
        assert tell([moved] * 100, [drove] * 100) == outcome


def test_a_robot_that_spins_in_place_is_stalled() -> None:
    """It turns, but its wheels take it nowhere; one that drives against soft ground is
    stuck.
    """
    ground = torch.stack([torch.full((16, 16), value) for value in (0.9, 0.0)])
    world = World(time_budget_s=12.0)
    goal = torch.tensor([[90.0, 90.0]]).expand(2, 2)
    simulation = Simulation(
        factories.terrain(ground, 0.0),
        factories.task(),
        world,
        factories.places(goal),
        0,
        range(2),
    )
    now = simulation.init(torch.tensor([[4.0, 4.0, 0.0]] * 2))
    action = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    states, driven = [now.state], []
    while now.running.any():
        driven.append(distance(simulation.unhindered(now, action), now.state[:, :2]))
        now, _ = simulation.step(now, action)
        states.append(now.state)
    assert now.state[0, 2] > 9
    positions = torch.stack(states, dim=1)[..., :2]
    told = classify_standstill(
        now.outcome, now.step, positions, torch.stack(driven, dim=1), 0.1
    )
    assert told.tolist() == [Outcome.STALLED, Outcome.STUCK]


def test_going_round_in_a_wide_circle_is_moving_and_in_a_narrow_one_is_not() -> None:
    for radius, expected in ((0.3, Outcome.TIMEOUT), (0.2, Outcome.STUCK)):
        angle = torch.arange(201, dtype=torch.float64) * 2 * math.pi / 50
        positions = torch.stack(
            (5 + radius * angle.cos(), 5 + radius * angle.sin()), dim=1
        )[None]
        drove = torch.full((1, 200), 2 * math.pi * radius / 50, dtype=torch.float64)
        told = classify_standstill(
            torch.tensor([Outcome.TIMEOUT]), torch.tensor([200]), positions, drove, DT_S
        )
        assert told.tolist() == [expected]


@pytest.mark.parametrize("outcome", [o for o in Outcome if o != Outcome.TIMEOUT])
def test_other_outcomes_stay(outcome: Outcome) -> None:
    assert tell([0.0] * 200, [0.0] * 200, outcome) == outcome
    assert tell([0.0] * 200, [1.0] * 200, outcome) == outcome


def test_an_episode_shorter_than_the_window_and_one_without_steps_are_told() -> None:
    assert tell([0.0] * 5, [2.0] * 5) == Outcome.STUCK
    assert tell([0.0] * 5, [0.1] * 5) == Outcome.STALLED
    ended, steps = torch.tensor([Outcome.PLANNER_ERROR]), torch.tensor([0])
    none = classify_standstill(
        ended, steps, torch.zeros(1, 1, 2), torch.zeros(1, 0), DT_S
    )
    assert none.tolist() == [Outcome.PLANNER_ERROR]


def test_each_episode_of_a_batch_is_told_by_itself() -> None:
    outcome = torch.tensor(
        [Outcome.TIMEOUT, Outcome.SUCCESS, Outcome.TIMEOUT, Outcome.TIMEOUT]
    )
    x = torch.zeros(4, 201)
    x[3] = torch.arange(201) * 0.01
    drove = torch.tensor([[0.1], [0.1], [0.0], [0.1]]).expand(4, 200)
    steps = torch.full((4,), 200)
    told = classify_standstill(
        outcome, steps, torch.stack((x, torch.zeros_like(x)), dim=2), drove, DT_S
    )
    assert told.tolist() == [
        Outcome.STUCK,
        Outcome.SUCCESS,
        Outcome.STALLED,
        Outcome.TIMEOUT,
    ]
    assert outcome.tolist() == [
        Outcome.TIMEOUT,
        Outcome.SUCCESS,
        Outcome.TIMEOUT,
        Outcome.TIMEOUT,
    ]


def test_the_last_ten_seconds_of_an_episode_are_those_before_its_own_end() -> None:
    """A batch goes on until its last episode ends; meanwhile the others stand where
    they ended.
    """
    moved = torch.full((2, 300), 0.02)
    moved[:, 150:] = 0.0
    positions = torch.nn.functional.pad(moved.cumsum(dim=1), (1, 0))[
        ..., None
    ] * torch.tensor([1.0, 0.0])
    outcome, steps = torch.tensor([Outcome.TIMEOUT] * 2), torch.tensor([150, 300])
    told = classify_standstill(
        outcome, steps, positions, torch.full((2, 300), 0.1), DT_S
    )
    assert told.tolist() == [Outcome.TIMEOUT, Outcome.STUCK]
    told = classify_standstill(
        outcome, steps, positions, 0.01 * (moved + 1) * (moved == 0), DT_S
    )
    assert told.tolist() == [Outcome.TIMEOUT, Outcome.STUCK]


def test_what_the_wheels_did_after_an_episodes_end_is_not_looked_at() -> None:
    """Two stand still; one drives against the ground up to its own end, the other does
    not.
    """
    drove = torch.full((2, 300), 0.1)
    drove[0, 150:] = 0.0
    drove[1, :] = 0.0
    outcome, steps = torch.tensor([Outcome.TIMEOUT] * 2), torch.tensor([150, 300])
    told = classify_standstill(outcome, steps, torch.zeros(2, 301, 2), drove, DT_S)
    assert told.tolist() == [Outcome.STUCK, Outcome.STALLED]
