import math
from dataclasses import replace

import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import GoalDistance, Objective, TravelTime
from benchnav.planning.planners.astar import dwa as dwa_module
from benchnav.planning.planners.astar.dwa import (
    DWA,
    DWAConfig,
    DWAState,
    score,
    velocity_window,
)
from benchnav.planning.problem import Problem
from benchnav.planning.robots import DifferentialDrive, Unicycle
from tests import factories
from tests.planning.planners.driving import (
    fake_cuda,
    first,
    generator,
    held_paths,
    on_cuda,
    step_at,
)

CONFIG = DWAConfig()


def chosen(
    problem: Problem, state: torch.Tensor, velocity: torch.Tensor, target: torch.Tensor
) -> torch.Tensor:
    return DWA().plan_toward(step_at(state), DWAState(problem, velocity), target)[0]


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.7, -1.0)])
def test_without_limits_the_window_is_all_that_the_bounds_allow(
    velocity: tuple[float, float],
) -> None:
    robot = Unicycle(speed_mps=(-0.5, 2.0), turn_rate_radps=(-1.5, 1.0))
    problem = factories.problem(torch.full((2, 16, 16), 0.8), robot=robot)
    window = velocity_window(
        problem, torch.tensor([velocity] * 2), DWAConfig(speeds=6, turn_rates=11)
    )
    speeds, turn_rates = (
        (-0.5, 0.0, 0.5, 1.0, 1.5, 2.0),
        torch.linspace(-1.5, 1.0, 11).tolist(),
    )
    expected = torch.tensor([(v, w) for v in speeds for w in turn_rates])
    torch.testing.assert_close(window, torch.stack((expected, expected)))


def test_the_default_window_has_standing_and_straight_driving_in_it() -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.8))
    pairs = {
        tuple(pair)
        for pair in velocity_window(problem, torch.zeros(1, 2), CONFIG)[0].tolist()
    }
    assert len(pairs) == CONFIG.speeds * CONFIG.turn_rates
    assert {(0.0, 0.0), (1.0, 0.0), (0.0, -1.0), (1.0, 1.0)} <= pairs


def test_the_window_of_a_robot_with_limits_is_what_it_reaches_within_its_bounds() -> (
    None
):
    robot = DifferentialDrive(acceleration_mps2=0.8, turn_acceleration_radps2=0.3)
    problem = factories.problem(torch.full((2, 16, 16), 0.8), robot=robot)
    window = velocity_window(
        problem, torch.tensor([[0.5, 0.0], [0.98, -1.0]]), DWAConfig(speeds=3)
    )
    assert window.shape == (2, 3 * CONFIG.turn_rates, 2)
    torch.testing.assert_close(
        window.amin(1), torch.tensor([[0.42, -0.03], [0.90, -1.0]])
    )
    torch.testing.assert_close(
        window.amax(1), torch.tensor([[0.58, 0.03], [1.0, -0.97]])
    )
    assert len(window[0].unique(dim=0)) == 3 * CONFIG.turn_rates


def test_it_knows_the_velocity_that_a_robot_took() -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.8))
    taken = torch.tensor([[1.0, -1.0]])
    dwa = DWA()
    state = dwa.init(problem, generator())
    assert state.velocity.tolist() == [[0.0, 0.0]]
    assert torch.equal(dwa.commit_action(state, taken).velocity, taken)
    # A robot with limits gets no farther than these.
    limited = replace(problem, task=replace(problem.task, robot=DifferentialDrive()))
    state = dwa.commit_action(dwa.init(limited, generator()), taken)
    torch.testing.assert_close(state.velocity, torch.tensor([[0.05, -0.1]]))


def test_costs_equal_a_loop_over_pairs_and_steps() -> None:
    maps = torch.rand(2, 16, 20, generator=generator())
    maps[0] = maps[0].clamp(min=0.31)
    problem = factories.problem(maps, start=(3.3, 2.2))
    assert not problem.free[1, 4, 6:9].all()
    target = torch.tensor([[3.6, 2.6], [7.0, 6.0]])
    window = torch.tensor([[[0.9, 0.2], [0.1, -0.7]], [[0.0, 0.0], [1.0, 1.0]]])
    config = DWAConfig(horizon_s=2.3, heading_weight=0.1, arrival_m=0.3)
    cost = score(problem, problem.start, window, target, config)
    positions = held_paths(problem, problem.start, window, 23)
    assert positions.shape == (2, 2, 24, 2)
    arrivals = 0
    for b in range(2):
        for m in range(2):
            x, y, heading = problem.start[b].tolist()
            gx, gy = target[b].tolist()
            v, w = window[b, m].tolist()
            expected, arrived = 0.0, False
            for t in range(24):
                row, column = int(y // 0.5), int(x // 0.5)
                penalty = 0 if problem.free[b, row, column] else 1e4
                if not arrived:
                    expected += math.hypot(x - gx, y - gy) + penalty
                if t == 23:
                    break
                lam = max(maps[b, row, column].item(), 0.3)
                x, y = (
                    x + 0.1 * lam * v * math.cos(heading),
                    y + 0.1 * lam * v * math.sin(heading),
                )
                heading += 0.1 * lam * w
                arrived = arrived or math.hypot(x - gx, y - gy) <= 0.3
                assert positions[b, m, t + 1].tolist() == pytest.approx(
                    [x, y], abs=1e-4
                )
            if not arrived:
                bearing = math.atan2(gy - 2.2, gx - 3.3)
                # A robot that stands pays for its distance at each step and at the end.
                standing = 24 * math.hypot(3.3 - gx, 2.2 - gy)
                expected += 0.1 * standing * abs(bearing - heading)
            arrivals += arrived
            assert cost[b, m].item() == pytest.approx(expected, rel=1e-4)
    assert arrivals == 1


def test_it_speeds_up_toward_a_far_waypoint_and_turns_to_one_aside() -> None:
    problem = factories.problem(
        torch.full((2, 16, 16), 0.8), start=(2.0, 2.0), goal=(6.0, 6.0)
    )
    waypoint = torch.tensor([[6.0, 6.0], [2.0, 6.0]])
    velocity = chosen(problem, problem.start, torch.tensor([[0.5, 0.0]] * 2), waypoint)
    assert velocity[0].tolist() == [1.0, 0.0]
    assert velocity[1, 1] > 0.3
    # One with limits does what it can.
    ground = torch.full((2, 16, 16), 0.8)
    limited = factories.problem(
        ground, start=(2.0, 2.0), goal=(6.0, 6.0), robot=DifferentialDrive()
    )
    velocity = chosen(limited, limited.start, torch.tensor([[0.5, 0.0]] * 2), waypoint)
    assert velocity[0].tolist() == pytest.approx([0.55, 0.0], abs=1e-6)
    assert velocity[1, 1] > 0.04


def test_it_brakes_before_a_wall() -> None:
    walled = torch.full((1, 16, 16), 0.9)
    walled[:, :, 8:] = 0.1
    problem = factories.problem(walled, start=(3.4, 4.0), goal=(7.0, 4.0))
    # The arc ends before the wall, which is 0.6 m away: at λ̂ 0.9, 0.13 m/s are held
    # for five seconds.
    assert (
        0
        < chosen(problem, problem.start, torch.tensor([[0.3, 0.0]]), problem.goal_m)[
            0, 0
        ]
        < 0.134
    )
    limited = factories.problem(
        walled, start=(3.4, 4.0), goal=(7.0, 4.0), robot=DifferentialDrive()
    )
    start = limited.start + torch.tensor([[0.0, 0.0, 0.0, 0.3, 0.0]])
    assert (
        chosen(limited, start, torch.tensor([[0.3, 0.0]]), limited.goal_m)[0, 0] < 0.26
    )


def test_it_drives_out_of_ground_predicted_to_hold_it() -> None:
    problem = factories.problem(
        torch.zeros(1, 16, 16), start=(4.0, 4.0), goal=(7.0, 4.0)
    )
    velocity = chosen(
        problem, problem.start, torch.tensor([[0.3, 0.0]]), problem.goal_m
    )
    assert velocity[0].tolist() == [1.0, 0.0]


def test_a_robot_that_spins_stops_spinning() -> None:
    ground, robot = (
        torch.full((1, 16, 16), 0.8),
        DifferentialDrive(turn_acceleration_radps2=0.5),
    )
    problem = factories.problem(ground, start=(4.0, 4.0), goal=(4.0, 7.0), robot=robot)
    state, velocity = problem.start.clone(), torch.tensor([[0.0, -1.0]])
    state[0, 4] = -1.0
    for _ in range(120):
        velocity = chosen(problem, state, velocity, problem.goal_m)
        state = problem.robot(state, velocity, problem.traversability_at(state))
        if torch.linalg.vector_norm(state[0, :2] - problem.goal_m[0]) < 1:
            break
    else:
        pytest.fail("it did not arrive")
    # It has turned back, and not gone round.
    assert velocity[0, 1] > 0
    assert abs(state[0, 2] - problem.start[0, 2]) < math.pi


def test_it_turns_on_the_spot_toward_a_waypoint_behind_on_either_side() -> None:
    problem = factories.problem(
        torch.full((2, 16, 16), 0.8), start=(4.0, 4.0), goal=(4.0, 7.0)
    )
    state = torch.tensor([[4.0, 4.0, -0.3], [4.0, 4.0, 3.4]])
    behind = torch.tensor([[1.0, 4.0], [7.0, 4.0]])
    velocity = chosen(problem, state, torch.zeros(2, 2), behind)
    # The shorter way round: from −0.3 to −π rightward, from 3.4 to 2π leftward.
    assert velocity[0, 1] < -0.4
    assert velocity[1, 1] > 0.4


def test_a_near_waypoint_does_not_slow_the_robot() -> None:
    problem = factories.problem(
        torch.full((1, 16, 16), 0.9), start=(2.0, 4.0), goal=(7.0, 4.0)
    )
    near = torch.tensor([[3.0, 4.0]])
    velocity = chosen(problem, problem.start, torch.tensor([[0.6, 0.0]]), near)
    assert velocity[0].tolist() == [1.0, 0.0]


def test_trajectories_are_stacked_only_to_be_drawn() -> None:
    problem = factories.problem(torch.full((2, 16, 16), 0.9))
    dwa = DWA()
    state = dwa.init(problem, generator())
    quiet, _, nothing = dwa.plan_toward(first(problem), state, problem.goal_m)
    action, _, plan = dwa.plan_toward(first(problem, draw=True), state, problem.goal_m)
    assert torch.equal(action, quiet)
    assert nothing.samples.numel() == nothing.path.numel() == 0
    assert plan.samples.shape == (2, CONFIG.speeds * CONFIG.turn_rates, 11, 2)
    assert plan.path.shape == (2, 51, 2)
    expected = problem.robot(
        problem.start, action, problem.traversability_at(problem.start)
    )
    torch.testing.assert_close(plan.path[:, 1], expected[:, :2])


def test_no_tensor_is_made_on_another_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dwa_module, "Fused", lambda function, *_, **__: function)
    with fake_cuda(
        factories.problem(torch.full((2, 16, 20), 0.9), robot=DifferentialDrive())
    ) as problem:
        dwa = DWA()
        action, state, plan = dwa.plan_toward(
            first(problem, draw=True), dwa.init(problem, generator()), problem.goal_m
        )
        assert on_cuda(
            action,
            dwa.commit_action(state, action).velocity,
            plan.path,
            plan.samples,
            plan.status,
        )


@pytest.mark.parametrize(
    ("horizon_s", "dt_s", "steps"),
    [(2.0, 0.1, 20), (2.0, 0.25, 8), (2.4, 1.0, 2), (0.2, 1.0, 1)],
)
def test_the_horizon_is_in_seconds_and_has_a_step_at_least(
    horizon_s: float, dt_s: float, steps: int
) -> None:
    problem = factories.problem(torch.full((1, 16, 16), 1.0), robot=Unicycle(dt_s=dt_s))
    dwa = DWA(DWAConfig(horizon_s=horizon_s))
    _, _, plan = dwa.plan_toward(
        first(problem, draw=True), dwa.init(problem, generator()), problem.goal_m
    )
    assert plan.path.shape == (1, steps + 1, 2)
    ahead = torch.tensor([[[1.0, 0.0]]])
    far = score(
        problem,
        problem.start,
        ahead,
        problem.goal_m,
        DWAConfig(horizon_s=horizon_s, heading_weight=0),
    )
    away = (problem.start[0, :2] - problem.goal_m[0]).norm().item()
    summed = sum(away - dt_s * number for number in range(steps + 1))
    assert far.item() == pytest.approx(summed, rel=1e-5)


class Scaled(Objective):
    """An objective in other units: so many times another."""

    def __init__(self, other: Objective, scale: float) -> None:
        self.other, self.scale = other, scale

    def stage(self, *given: torch.Tensor) -> torch.Tensor:
        return self.scale * self.other.stage(*given)

    def terminal(self, *given: torch.Tensor) -> torch.Tensor:
        return self.scale * self.other.terminal(*given)


@pytest.mark.parametrize("objective", [GoalDistance(), TravelTime(Unicycle(), 1.0)])
def test_the_heading_weighs_alike_in_whatever_unit_an_objective_counts(
    objective: Objective,
) -> None:
    ground = torch.full((3, 16, 16), 0.8)
    target = torch.tensor([[6.0, 5.0], [2.0, 6.0], [7.0, 7.0]])
    costs = []
    for scale in (1.0, 1024.0):
        problem = factories.problem(
            ground, start=(4.0, 4.0), objective=Scaled(objective, scale)
        )
        window = velocity_window(problem, torch.zeros(3, 2), CONFIG)
        costs.append(score(problem, problem.start, window, target, CONFIG) / scale)
    torch.testing.assert_close(costs[0], costs[1])


def test_a_penalty_is_no_part_of_what_the_heading_weighs() -> None:
    free = factories.problem(
        torch.full((1, 16, 16), 0.35), start=(4.0, 4.0), goal=(7.0, 7.0)
    )
    not_free = replace(free, free=torch.zeros_like(free.free))
    stand = torch.zeros(1, 1, 2)
    costs = [
        score(problem, problem.start, stand, torch.tensor([[6.0, 5.0]]), CONFIG).item()
        for problem in (free, not_free)
    ]
    assert costs[1] - costs[0] == pytest.approx(51 * PENALTY)


@pytest.mark.parametrize("value", [0, -1, math.inf, math.nan])
@pytest.mark.parametrize("name", ["speeds", "turn_rates", "horizon_s"])
def test_an_empty_window_is_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=name):
        DWAConfig(**{name: value})


@pytest.mark.parametrize("value", [-1, math.inf, math.nan])
@pytest.mark.parametrize("name", ["heading_weight", "arrival_m"])
def test_weights_that_mean_nothing_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=name):
        DWAConfig(**{name: value})
