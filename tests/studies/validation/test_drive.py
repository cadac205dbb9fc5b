import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.planning import MPPIConfig, Plan, Planner, Problem, Step
from benchnav.planning.free_space import PENALTY
from benchnav.planning.planners.mppi_rollouts import advance_chunk
from benchnav.planning.planners.noise_bank import Sampled
from benchnav.planning.problem import Dynamics, ground_map
from benchnav.planning.robots import component_wise
from studies.validation.drive import (
    ManyTrialsMPPI,
    advance_pair,
    drive,
    has_arrived,
    move,
    traction_at,
)
from studies.validation.task import ROVER, Setup, choose_objective, planner_config, pose
from studies.validation.world import GRID, draw_vegetation

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
    assert float(arrival_s) == pytest.approx(
        math.ceil((8 * math.sqrt(2) - 0.5) / (3.0 * DT_S)) * DT_S
    )


def test_a_blocked_cell_holds_the_robot() -> None:
    traction = ground(1.0, 1.0, trials=2)
    traction[0, 0, 4, 4] = 0.0  # rows are y, and the diagonal leads through it
    held = Blind(3.0)
    arrival_s = drive(held, problem(2), traction, rng.generator(0))
    assert arrival_s.isinf().tolist() == [True, False]
    last = held.seen[-1].state[0]
    assert (last[:2].floor() == 4).all()
    assert float(held.seen[-1].traversability[0]) == 0.0


def test_traction_is_read_by_row_and_column_and_is_nothing_off_the_map() -> None:
    traction = torch.arange(2 * 81.0).reshape(1, 2, 9, 9) + 1
    inside = traction_at(torch.tensor([[3.7, 6.2, 0.0]]), traction)
    assert inside.tolist() == [[1 + 6 * 9 + 3, 1 + 81 + 6 * 9 + 3]]
    for x, y in ((-0.01, 4.0), (9.0, 4.0), (4.0, -0.01), (4.0, 9.0)):
        assert traction_at(torch.tensor([[x, y, 0.0]]), traction).tolist() == [
            [0.0, 0.0]
        ]


def test_rollouts_on_pairs_move_as_the_world_does() -> None:
    fields = (
        torch.rand((3, 2, *GRID.shape), generator=torch.Generator().manual_seed(0))
        + 0.02
    )
    padded = ground_map(
        GRID, fields, torch.ones_like(fields, dtype=torch.bool)
    ).flatten(1)
    draws = torch.randn((2, 12, 5), generator=torch.Generator().manual_seed(1))
    noise = torch.stack((draws[0].abs(), draws[1]), dim=1)
    start = torch.tensor([0.5, 0.5, math.pi / 4]).expand(3, 5, 3)
    task, sampled = (
        problem().task,
        Sampled(torch.zeros(3, 12, 2), noise, *problem().action_bounds),
    )
    target, dynamics = (
        torch.tensor([[[8.5, 8.5]]]),
        Dynamics(GRID, task.robot, task.objective, 1e-6),
    )
    states, _ = advance_pair(
        start, torch.zeros(3, 5), sampled, padded, target.expand(3, 1, 2), dynamics
    )
    for sample in range(5):
        state = start[:, sample]
        for action in noise[:, :, sample]:
            state = move(
                state, action.clamp(-math.pi, math.pi).expand(3, 2), fields, DT_S
            )
        torch.testing.assert_close(states[:, sample], state, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("power", [1, 2])
def test_a_pair_of_equal_fields_costs_what_one_field_does(power: int) -> None:
    setup = Setup(distance_power=power)
    posed = pose(draw_vegetation(0, np.arange(2), 0.4), ["mean"], setup)
    turns = torch.randn(90, 4, generator=torch.Generator().manual_seed(0)) / 10
    noise = torch.stack((torch.full((90, 4), 3.0), turns), dim=1)
    noise[:, 0, 2:] /= 10  # these never arrive
    start = component_wise(posed.start[:, None].expand(2, 4, 3))
    sampled = Sampled(torch.zeros(2, 90, 2), noise, *posed.action_bounds)
    given, parts = (
        (torch.zeros(2, 4), sampled),
        (posed.goal_m[:, None].contiguous(), posed.dynamics),
    )
    states, cost = advance_chunk(start, *given, posed.padded_ground, *parts)
    states_of_pair, cost_of_pair = advance_pair(
        start, *given, posed.padded_ground.repeat(1, 2), *parts
    )
    assert has_arrived(states.flatten(0, 1)).any()
    torch.testing.assert_close(states_of_pair, states, atol=1e-4, rtol=0)
    torch.testing.assert_close(cost_of_pair, cost, rtol=1e-5, atol=0)


def planned_ground(setup: Setup, setting: str = "cost") -> Tensor:
    config = planner_config(setting, setup)
    planner = ManyTrialsMPPI(config, setup)
    posed = pose(draw_vegetation(0, np.arange(2), 0.4), [setting], setup)
    return planner._padded_ground(planner.init(posed, rng.generator(0)), posed.start)


@pytest.mark.parametrize("motions", ["one", "two"])
@pytest.mark.parametrize("setting", ["mean", "cost"])
def test_a_rollout_off_the_map_pays_the_penalty_or_is_still(
    setting: str, motions: str
) -> None:
    setup = Setup(
        mppi=MPPIConfig(samples=4, horizon_s=0.2),
        min_traversability=1e-6,
        motions=motions,
        fields=26,
    )
    off = torch.tensor([[[-0.5, 4.0, 0.0]]])
    for off_map, penalty in (("penalty", PENALTY), ("still", 0.0)):
        ground = planned_ground(replace(setup, off_map=off_map), setting)[:1]
        is_paired = len(ground[0]) == 2 * 121
        assert is_paired == (setting == "cost" and motions == "two")
        pair = ground if is_paired else torch.cat((ground, ground), dim=1)
        sampled = Sampled(
            torch.full((1, 2, 2), 3.0), torch.zeros(2, 2, 1), *problem().action_bounds
        )
        dynamics = Dynamics(
            GRID, ROVER, choose_objective(setup), setup.min_traversability
        )
        target = torch.tensor([[[8.5, 8.5]]])
        states, cost = advance_pair(
            off, torch.zeros(1, 1), sampled, pair, target, dynamics
        )
        torch.testing.assert_close(states, off, atol=1e-5, rtol=0)
        assert float(cost) == pytest.approx(
            2 * (0.1 + math.hypot(9, 4.5) + penalty), rel=1e-4
        )
