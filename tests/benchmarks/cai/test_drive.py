import math

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.cai.drive import drive, has_arrived, move, traction_at
from benchmarks.cai.task import STEPS, Setup, pose
from benchmarks.cai.world import GRID, draw_vegetation
from benchnav.core import rng
from benchnav.planning.planners.planner import Plan, Planner
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.sensor import Step

DT_S = 0.1


class Blind(Planner[int]):
    """Commands one action for ever."""

    def __init__(self, speed_mps: float, turn_rate_radps: float = 0.0) -> None:
        self.action = torch.tensor([speed_mps, turn_rate_radps])
        self.seen: list[Step] = []

    def init(self, problem: Problem, generator: torch.Generator) -> int:
        return len(problem)

    def plan(self, step: Step, plan_state: int) -> tuple[Tensor, int, Plan]:
        self.seen.append(step)
        return self.action.expand(plan_state, 2), plan_state, Plan.empty(plan_state)


def ground(linear: float, angular: float, trials: int = 1) -> Tensor:
    values = torch.tensor([linear, angular])
    return values[None, :, None, None].expand(trials, 2, *GRID.shape).clone()


def problem(trials: int = 1) -> Problem:
    return pose(draw_vegetation(0, np.arange(trials), 0.4), ["mean"], Setup())


def test_free_ground_is_crossed_at_the_commanded_speed() -> None:
    # 8√2 m from start to goal, of which the last 0.5 m need not be driven.
    arrival_s = drive(Blind(3.0), problem(), ground(1.0, 1.0), rng.generator(0))
    assert float(arrival_s) == pytest.approx(math.ceil((8 * math.sqrt(2) - 0.5) / (3.0 * DT_S)) * DT_S)


def test_traction_scales_the_time() -> None:
    arrival_s = drive(Blind(3.0), problem(), ground(0.5, 1.0), rng.generator(0))
    assert float(arrival_s) == pytest.approx(math.ceil((8 * math.sqrt(2) - 0.5) / (1.5 * DT_S)) * DT_S)


def test_time_ends_a_trial() -> None:
    slow = Blind(0.7)  # 10.5 m in 15 s: 0.31 m short
    assert float(drive(slow, problem(), ground(1.0, 1.0), rng.generator(0))) == math.inf
    assert len(slow.seen) == STEPS
    assert math.isfinite(drive(Blind(0.73), problem(), ground(1.0, 1.0), rng.generator(0)))


def test_a_blocked_cell_holds_the_robot() -> None:
    traction = ground(1.0, 1.0, trials=2)
    traction[0, 0, 4, 4] = 0.0  # rows are y, and the diagonal leads through it
    held = Blind(3.0)
    arrival_s = drive(held, problem(2), traction, rng.generator(0))
    assert arrival_s.isinf().tolist() == [True, False]
    last = held.seen[-1].state[0]
    assert (last[:2].floor() == 4).all()
    assert float(held.seen[-1].traversability[0]) == 0.0


def test_a_trial_that_has_ended_does_not_move_on() -> None:
    traction = ground(1.0, 1.0, trials=2)
    traction[1, 0] = 0.0
    watched = Blind(3.0)
    drive(watched, problem(2), traction, rng.generator(0))
    assert bool(has_arrived(watched.seen[-1].state)[0])


def test_a_robot_turns_by_angular_traction_alone() -> None:
    state, action = torch.tensor([[4.5, 4.5, 0.3]]), torch.tensor([[2.0, 1.5]])
    still = move(state, action, ground(0.8, 0.0), DT_S)
    assert float(still[0, 2]) == pytest.approx(0.3)
    assert float(torch.hypot(*(still - state)[0, :2])) == pytest.approx(0.8 * 2.0 * DT_S, rel=1e-4)
    turned = move(state, action, ground(0.0, 0.4), DT_S)
    assert turned[0].tolist() == pytest.approx([4.5, 4.5, 0.3 + 0.4 * 1.5 * DT_S])


def test_a_circle_has_the_radius_of_both_tractions() -> None:
    state, action = torch.tensor([[4.5, 4.5, 0.0]], dtype=torch.float64), torch.tensor([[1.0, 1.0]]).double()
    linear, angular, dt_s = 0.5, 0.8, 1e-3
    for _ in range(round(math.pi / (angular * dt_s))):
        state = move(state, action, ground(linear, angular).double(), dt_s)
    diameter = 2 * linear / angular
    assert state[0].tolist() == pytest.approx([4.5, 4.5 + diameter, math.pi], abs=0.01)


def test_traction_is_read_by_row_and_column_and_is_nothing_off_the_map() -> None:
    traction = torch.arange(2 * 81.0).reshape(1, 2, 9, 9) + 1
    inside = traction_at(torch.tensor([[3.7, 6.2, 0.0]]), traction)
    assert inside.tolist() == [[1 + 6 * 9 + 3, 1 + 81 + 6 * 9 + 3]]
    for x, y in ((-0.01, 4.0), (9.0, 4.0), (4.0, -0.01), (4.0, 9.0)):
        assert traction_at(torch.tensor([[x, y, 0.0]]), traction).tolist() == [[0.0, 0.0]]


def test_arrival_is_within_half_a_metre() -> None:
    state = torch.tensor([[8.5, 8.01, 0.0], [8.5, 7.99, 0.0], [8.1, 8.1, 0.0]])
    assert has_arrived(state).tolist() == [True, False, False]
