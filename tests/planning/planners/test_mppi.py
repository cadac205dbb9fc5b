import math
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.planning.free_space import FreeSpace, Immobile, Rules
from benchnav.planning.objective import GoalDistance, Objective
from benchnav.planning.planners import mppi, mppi_rollouts
from benchnav.planning.planners.cost_risk import pad_fields
from benchnav.planning.planners.mppi import MPPI, MPPIState
from benchnav.planning.planners.mppi_config import MPPIConfig
from benchnav.planning.planners.noise_bank import NoiseBank, draw_bank
from benchnav.planning.planners.straight import Straight
from benchnav.planning.planners.turns import (
    follow_dubins,
    is_steered,
    turning_primitives,
)
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Bicycle, DifferentialDrive, Unicycle
from benchnav.planning.world.outcome import Outcome
from tests import factories
from tests.planning.planners.driving import (
    drive,
    fake_cuda,
    first,
    generator,
    on_cuda,
    rollout_cost,
    with_start,
)

SMALL = MPPIConfig(samples=256, horizon_s=2)


def test_rollout_cost_equals_a_loop_over_samples() -> None:
    maps = 0.31 + 0.6 * torch.rand(2, 16, 12, generator=generator())
    maps[1, 2, 2] = 0.1
    problem = factories.problem(maps, start=(1.4, 1.25), goal=(4.25, 6.75))
    target = problem.goal_m + 0.3
    mean = torch.rand(2, 13, 2, generator=generator(1))
    noise = torch.randn(13, 2, 5, generator=generator(2))
    cost = rollout_cost(problem, problem.start, mean, noise, target)
    for b in range(2):
        for k in range(5):
            x, y, heading = problem.start[b].tolist()
            expected = 0.0
            for t in range(14):
                row, column = int(y // 0.5), int(x // 0.5)
                inside = 0 <= row < 16 and 0 <= column < 12 and x >= 0 and y >= 0
                free = inside and bool(problem.free[b, row, column])
                lam = (
                    max(problem.risk_map[b, row, column].item(), 0.3) if inside else 0.0
                )
                gx, gy = target[b].tolist()
                expected += math.hypot(x - gx, y - gy) + (0 if free else 1e4)
                if t < 13:
                    v = min(max(mean[b, t, 0].item() + noise[t, 0, k].item(), 0), 1)
                    w = min(max(mean[b, t, 1].item() + noise[t, 1, k].item(), -1), 1)
                    x += 0.1 * lam * v * math.cos(heading)
                    y += 0.1 * lam * v * math.sin(heading)
                    heading += 0.1 * lam * w
            assert cost[b, k].item() == pytest.approx(expected, rel=1e-5, abs=1e-2)
    # Some leave the cell that is not free sooner than others.
    assert cost[0].max() < 1e4 < 3e4 < cost[1].min() < cost[1].max() - 1e4


@pytest.mark.parametrize("control_cost", [0.0, 0.4])
@pytest.mark.parametrize("temperature", [0.5, None])
def test_the_mean_is_moved_by_the_softmax_average_of_the_noise(
    control_cost: float, temperature: float | None
) -> None:
    share = 0.3 if temperature is None else MPPIConfig.temperature_share
    config = replace(
        SMALL,
        control_cost=control_cost,
        noise=(0.3, 0.6),
        temperature=temperature,
        temperature_share=share,
    )
    problem = factories.problem(torch.full((1, 16, 16), 0.8))
    planner = MPPI(config)
    state = planner.init(problem, generator(3))
    state = replace(state, mean=torch.rand(state.mean.shape, generator=generator(4)))
    action, following, _ = planner.plan(first(problem), state)
    noise = state.noise.at(state.step)
    cost = rollout_cost(problem, problem.start, state.mean, noise, problem.goal_m)[
        0
    ].double()
    for step in range(20):
        for axis, scale in enumerate(config.noise):
            cost += (
                control_cost * state.mean[0, step, axis] * noise[step, axis] / scale**2
            )
    weights = torch.exp(
        -(cost - cost.min()) / (temperature or 0.3 * (cost - cost.min()).mean())
    )
    low, high = torch.tensor([0.0, -1.0]), torch.tensor([1.0, 1.0])
    moved = state.mean[0] + (noise * (weights / weights.sum())).sum(-1)
    mean = moved.clamp(low, high)
    assert bool((mean != moved).any())
    torch.testing.assert_close(action[0].double(), mean[0], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(
        following.mean[0, :-1].double(), mean[1:], atol=1e-5, rtol=1e-4
    )
    torch.testing.assert_close(
        following.mean[0, -1].double(), mean[-1], atol=1e-5, rtol=1e-4
    )


def test_where_costs_are_flat_the_mean_stays_at_its_bound() -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.8), objective=Free())
    planner = MPPI(MPPIConfig(horizon_s=1.0, samples=4000))
    planner._advance.compiled = planner._weigh.compiled = False
    state = planner.init(problem, generator())
    state = replace(state, mean=torch.tensor([1.0, -1.0]).expand_as(state.mean))
    for _ in range(5):
        _, state, _ = planner.plan(first(problem), state)
    # Averages of clipped samples would lie at 0.8 and −0.6 after the first step.
    assert state.mean[..., 0].mean() > 0.95
    assert state.mean[..., 1].mean() < -0.9


def test_the_average_reaches_the_bounds_and_no_further() -> None:
    mean, noise = (
        torch.tensor([[[3.0, 0.0]]]),
        torch.tensor([[[-1.0, 1.0], [0.5, 1.5]]]),
    )
    weights, low, high = (
        torch.full((1, 2), 0.5),
        torch.tensor([0.0, -1.0]),
        torch.tensor([3.0, 1.0]),
    )
    assert mppi_rollouts.average(mean, noise, weights, low, high)[0, 0].tolist() == [
        3.0,
        1.0,
    ]
    first_only = torch.tensor([[1.0, 0.0]])
    assert mppi_rollouts.average(mean, noise, first_only, low, high)[0, 0].tolist() == [
        2.0,
        0.5,
    ]


def test_the_spread_is_the_mean_excess_of_samples_that_pay_no_more_steps_off_free_ground() -> (
    None
):
    cost = torch.tensor(
        [[3.0, 1.0, 2.0, 1e4 + 2.0], [2e4 + 5.0, 3e4, 2e4 + 6.0, 2e4 + 7.0], [4.0] * 4]
    )
    assert mppi_rollouts.cost_spread(cost)[:2, 0].tolist() == pytest.approx([1.0, 1.0])
    assert 0 < mppi_rollouts.cost_spread(cost)[2, 0] < 1e-20


class Scaled(GoalDistance):
    """The distance in millimetres."""

    def stage(self, state, action, traversability, target):  # type: ignore[no-untyped-def]
        return 1000 * super().stage(state, action, traversability, target)

    def terminal(self, state, traversability, target):  # type: ignore[no-untyped-def]
        return 1000 * super().terminal(state, traversability, target)


@pytest.mark.parametrize(("temperature", "same"), [(None, True), (0.5, False)])
def test_by_default_the_unit_of_the_objective_changes_nothing(
    temperature: float | None, same: bool
) -> None:
    actions = []
    for objective in (GoalDistance(), Scaled()):
        # A short horizon: 1000 times what it costs stays below the penalty of ground
        # that is not free.
        problem = factories.problem(
            torch.full((1, 16, 16), 0.8), (5.75, 5.75), objective=objective
        )
        planner = MPPI(replace(SMALL, horizon_s=0.5, temperature=temperature))
        actions.append(
            planner.plan(first(problem), planner.init(problem, generator()))[0]
        )
    assert torch.allclose(*actions, atol=1e-3) is same


@dataclass(frozen=True, kw_only=True)
class Pushed(Unicycle):
    """Driven by a force along its heading, in newtons, and a turn rate; drag holds it
    at 1 m/s.
    """

    mass_kg: float = 1.0

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("force_n", "turn_rate_radps")

    @property
    def action_low(self) -> tuple[float, ...]:
        return (-self.mass_kg, -1.0)

    @property
    def action_high(self) -> tuple[float, ...]:
        return (self.mass_kg, 1.0)

    def initial_state(self, pose: torch.Tensor) -> torch.Tensor:
        return torch.cat((pose, torch.zeros_like(pose[..., :1])), dim=-1)

    def __call__(
        self, state: torch.Tensor, action: torch.Tensor, traversability: torch.Tensor
    ) -> torch.Tensor:
        speed = (state[..., 3] + self.dt_s * (action[..., 0] / self.mass_kg)).clamp(
            -1.0, 1.0
        )
        moved = torch.stack((speed, action[..., 1]), dim=-1)
        return torch.cat(
            (super().__call__(state[..., :3], moved, traversability), speed[..., None]),
            dim=-1,
        )


def test_a_robot_driven_by_newtons_does_as_one_driven_by_accelerations() -> None:
    ground = torch.full((1, 16, 16), 0.9)
    steps = []
    for mass_kg in (1.0, 150.0):
        problem = factories.problem(
            ground, goal=(5.25, 4.25), robot=Pushed(mass_kg=mass_kg)
        )
        driven = drive(MPPI(replace(SMALL, horizon_s=3.0)), problem, time_budget_s=40)
        assert driven.outcome.tolist() == [Outcome.SUCCESS]
        steps.append(driven.steps[0].item())
    assert steps[1] == pytest.approx(steps[0], rel=0.05)
    assert steps[0] < 1.5 * (5.0 - 1.0) / 0.9 / 0.1


@pytest.mark.parametrize("name", registry.names("objective"))
def test_on_open_ground_the_defaults_take_hardly_longer_than_a_straight_line(
    name: str,
) -> None:
    robot = Unicycle()
    objective = registry.make("objective", name, robot=robot, goal_radius_m=1.0)
    ground = torch.full((1, 32, 32), 0.9)
    problem = factories.problem(ground, (3.0, 4.0), (13.0, 10.0), robot, objective)
    times = [
        drive(planner, problem, time_budget_s=40).steps.item()
        for planner in (Straight(), MPPI(MPPIConfig(samples=500)))
    ]
    assert times[1] <= 1.08 * times[0]


def test_noise_is_a_share_of_the_range_of_each_action_unless_it_is_given() -> None:
    problem = factories.problem(
        torch.full((1, 16, 16), 0.8), robot=Pushed(mass_kg=150.0)
    )
    scale = (
        MPPI(replace(SMALL, noise_share=0.25)).init(problem, generator()).noise.scale
    )
    assert scale.tolist() == pytest.approx([75.0, 0.5])
    given = replace(SMALL, noise=(3.0, 0.2))
    assert MPPI(given).init(problem, generator()).noise.scale.tolist() == pytest.approx(
        [3.0, 0.2]
    )


@pytest.mark.parametrize(
    ("horizon_s", "dt_s", "steps"),
    [(5.0, 0.1, 50), (1.0, 0.3, 3), (2.0, 0.3, 7), (0.1, 1.0, 1)],
)
def test_the_horizon_is_in_seconds(horizon_s: float, dt_s: float, steps: int) -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.8), robot=Unicycle(dt_s=dt_s))
    state = MPPI(replace(SMALL, horizon_s=horizon_s)).init(problem, generator())
    assert (state.mean.shape[1], state.noise.at(0).shape[0]) == (steps, steps)


class Free(Objective):
    """Costs nothing, wherever it leads."""

    def stage(self, state, action, traversability, target):  # type: ignore[no-untyped-def]
        return 0 * traversability

    def terminal(self, state, traversability, target):  # type: ignore[no-untyped-def]
        return 0 * traversability


def test_the_whole_control_cost_takes_actions_back_to_rest() -> None:
    # γ = temperature weighs samples about the mean u as if they were drawn about 0,
    # whatever u is; half of it as if about u/2.
    robot = Unicycle(speed_mps=(-9, 9), turn_rate_radps=(-9, 9))
    ground = torch.full((1, 99, 99), 0.5)
    problem = factories.problem(ground, (24, 24), (30, 30), robot, Free())
    config = MPPIConfig(
        horizon_s=0.2, samples=200_000, noise=(0.5, 0.5), temperature=0.7
    )
    mean = torch.tensor([[[0.4, -0.3], [-0.2, 0.5]]])
    for share in (1.0, 0.5):
        planner = MPPI(replace(config, control_cost=share * 0.7))
        state = replace(planner.init(problem, generator()), mean=mean)
        weighed = rollout_cost(
            problem, problem.start, mean, state.noise.at(0), problem.goal_m
        )
        assert (weighed == 0).all()
        planner._advance.compiled = planner._weigh.compiled = False
        action, following, _ = planner.plan(first(problem), state)
        torch.testing.assert_close(
            action[0], (1 - share) * mean[0, 0], atol=0.02, rtol=0
        )
        torch.testing.assert_close(
            following.mean[0, 0], (1 - share) * mean[0, 1], atol=0.02, rtol=0
        )


def test_noise_has_the_scale_that_is_set_and_is_another_for_each_seed() -> None:
    problem = factories.problem(torch.full((3, 16, 16), 0.8))
    planner = MPPI(MPPIConfig(horizon_s=3, noise=(0.2, 0.7)))
    state = planner.init(problem, generator())
    noise = state.noise.at(0)
    assert noise.shape == (30, 2, 5000)
    torch.testing.assert_close(
        noise.std(dim=(0, 2)), torch.tensor([0.2, 0.7]), atol=0.01, rtol=0
    )
    other = planner.init(problem, generator(1))
    assert (noise * other.noise.at(0)).mean().abs() < 0.005


def test_each_step_plans_with_noise_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.8))
    planner, used = MPPI(SMALL), []

    def none(bank: NoiseBank, step: int) -> torch.Tensor:
        used.append(step)
        return torch.zeros(20, 2, 256)

    monkeypatch.setattr(NoiseBank, "at", none)
    state = planner.init(problem, generator())
    for _ in range(3):
        _, state, _ = planner.plan(first(problem), state)
    assert used == [0, 1, 2]


def test_an_episode_alone_does_as_it_does_in_a_batch() -> None:
    maps = 0.4 + 0.6 * torch.rand(3, 16, 16, generator=generator())
    problem = factories.problem(maps)
    alone = problem.select(torch.tensor([1]))
    planner = MPPI(SMALL)
    states = [planner.init(given, generator()) for given in (problem, alone)]
    position = problem.start
    for _ in range(4):
        action, states[0], _ = planner.plan(
            replace(first(problem), state=position), states[0]
        )
        same, states[1], _ = planner.plan(
            replace(first(alone), state=position[1:2]), states[1]
        )
        torch.testing.assert_close(action[1], same[0], atol=1e-4, rtol=1e-4)
        position = problem.robot(position, action, problem.traversability_at(position))


def test_it_drives_at_the_target_that_it_is_given() -> None:
    problem = factories.problem(
        torch.full((1, 16, 16), 0.8), start=(4.0, 4.0), goal=(7.0, 4.0)
    )
    planner = MPPI(replace(SMALL, samples=1900, horizon_s=4, temperature=0.1))
    state = planner.init(problem, generator())
    aside = torch.tensor([[4.0, 7.0]])
    turns = [
        planner.plan_toward(first(problem), state, target)[1].mean[0, :, 1].mean()
        for target in (problem.goal_m, aside)
    ]
    assert turns[1] - turns[0] > 0.03
    assert torch.equal(
        planner.plan(first(problem), state)[1].mean[0, :, 1].mean(), turns[0]
    )
    assert planner.commit_action(state, aside) is state


@pytest.mark.parametrize("robot", [Unicycle(), DifferentialDrive(), Bicycle()])
def test_it_drives_robots_of_two_actions(robot) -> None:  # type: ignore[no-untyped-def]
    problem = factories.problem(torch.full((2, 16, 16), 0.85), robot=robot)
    driven = drive(MPPI(replace(SMALL, horizon_s=3)), problem, time_budget_s=25)
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * 2


def test_noise_for_another_number_of_actions_is_asked_for_by_name() -> None:
    class Three(Unicycle):
        @property
        def action_names(self) -> tuple[str, ...]:
            return ("speed_mps", "turn_rate_radps", "crab_mps")

    problem = factories.problem(torch.full((1, 16, 16), 0.85), robot=Three())
    with pytest.raises(
        ConfigError, match=r"`noise` of MPPI with 3 values .one for each of .*crab_mps"
    ):
        MPPI(replace(SMALL, noise=(0.5, 0.5))).init(problem, generator())
    MPPI(replace(SMALL, noise=(0.5, 0.5, 0.2))).init(problem, generator())


@pytest.mark.parametrize(
    "settings",
    [
        {"horizon_s": 0},
        {"samples": 0},
        {"temperature": 0.0},
        {"temperature_share": 0.0},
        {"noise_share": math.nan},
        {"noise": (0.3, 0.6), "noise_share": 0.25},
        {"temperature": 0.5, "temperature_share": 0.3},
        {"noise": ()},
        {"noise": (0.5, 0.0)},
        {"control_cost": -1},
    ],
)
def test_settings_that_sample_nothing_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(settings))):
        MPPIConfig(**settings)  # type: ignore[arg-type]


def test_a_low_temperature_takes_the_best_sample() -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.8))
    planner = MPPI(replace(SMALL, temperature=1e-4))
    state = planner.init(problem, generator())
    action, _, _ = planner.plan(first(problem), state)
    noise = state.noise.at(state.step)
    cost = rollout_cost(problem, problem.start, state.mean, noise, problem.goal_m)
    best = noise[0, :, cost.argmin()].clamp(
        torch.tensor([0.0, -1.0]), torch.tensor([1.0, 1.0])
    )
    torch.testing.assert_close(action[0], best, atol=1e-3, rtol=0)


def test_drawing_changes_no_action() -> None:
    problem = factories.problem(torch.full((2, 16, 16), 0.8))
    planner = MPPI(SMALL)
    state = planner.init(problem, generator())
    action, _, plan = planner.plan(first(problem), state)
    again, following, drawn = planner.plan(first(problem, draw=True), state)
    assert torch.equal(action, again)
    assert plan.samples.numel() == plan.path.numel() == 0
    assert drawn.samples.shape == (2, 40, 21, 2)
    assert drawn.path.shape == (2, 21, 2)
    moved = problem.robot(
        problem.start, again, problem.traversability_at(problem.start)
    )
    moved = problem.robot(moved, following.mean[:, 0], problem.traversability_at(moved))
    torch.testing.assert_close(drawn.path[:, 2], moved[:, :2])
    # The best samples end nearer to the goal than a standing robot.
    end = (drawn.samples[:, :, -1] - problem.goal_m[:, None]).norm(dim=-1)
    assert (end < (problem.start[:, :2] - problem.goal_m).norm(dim=-1)[:, None]).all()


def problem_on(robot) -> Problem:  # type: ignore[no-untyped-def]
    return factories.problem(torch.full((2, 16, 20), 0.9), robot=robot)


@pytest.mark.parametrize("robot", [Unicycle(), DifferentialDrive(), Bicycle()])
def test_no_tensor_is_made_on_another_device(
    robot, monkeypatch: pytest.MonkeyPatch
) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(mppi, "Fused", lambda function, *_, **__: function)
    with fake_cuda(problem_on(robot)) as problem:
        mean, scale = problem.start.new_zeros(2, 20, 2), problem.start.new_ones(2)
        values = mean.new_zeros(2, 20, 4 * 256)
        places = torch.zeros(20, 2, dtype=torch.int64, device=mean.device)
        bank = NoiseBank(
            scale=scale, values=values, offset=places, stride=places, samples=256
        )
        state = MPPIState(
            problem,
            mean,
            mean[:, 0, 0],
            mean[:, 0, 0] > 0,
            constant_fields=None,
            cost_to_go=None,
            noise=bank,
            key=0,
            step=0,
        )
        planner = MPPI(replace(SMALL, control_cost=0.1))
        action, state, plan = planner.plan(first(problem, draw=True), state)
        assert on_cuda(action, state.mean, plan.path, plan.samples, plan.status)
        cost = rollout_cost(
            problem, problem.start, state.mean, bank.at(1), problem.goal_m
        )
        assert on_cuda(cost)


SCALE = torch.tensor([0.2, 0.7])


def bank(seed: int = 5, horizon: int = 12, samples: int = 4000) -> NoiseBank:
    return draw_bank(seed, horizon, samples, SCALE)


def test_each_action_has_its_own_scale_and_shape() -> None:
    noise = bank().at(3)
    assert noise.shape == (12, 2, 4000)
    torch.testing.assert_close(noise.std(dim=(0, 2)), SCALE, atol=0.01, rtol=0)
    assert noise.mean(dim=(0, 2)).abs().max() < 0.01
    # Normal: a twentieth lies beyond 1.96 standard deviations, and three in a thousand
    # beyond 3.
    far = (noise / SCALE[:, None]).abs()
    assert (far > 1.96).double().mean().item() == pytest.approx(0.05, abs=0.004)
    assert (far > 3).double().mean().item() == pytest.approx(0.0027, abs=0.001)


def test_numbers_of_a_sample_are_independent_within_a_step() -> None:
    noise = (bank().at(7) / SCALE[:, None]).flatten(0, 1)
    together = noise @ noise.T / noise.shape[1]
    others = together - torch.diag(together.diagonal())
    assert others.abs().max() < 5 / noise.shape[1] ** 0.5


def test_steps_and_seeds_have_noise_of_their_own() -> None:
    one = bank()
    steps = torch.stack([one.at(step) for step in (0, 1, 2, 50)])
    for place in range(1, 4):
        assert (steps[0] * steps[place]).mean().abs() < 0.01
        assert not torch.equal(steps[0], steps[place])
    # Seeds in a row, and such as are alike in 32 bits, which is all that PyTorch's
    # generator looks at.
    for seed in (6, 5 + 2**32):
        assert not torch.equal(bank(seed).at(0), one.at(0))
        assert not torch.equal(bank(seed).at(0), one.at(1))


def test_noise_is_a_function_of_seed_and_step_alone() -> None:
    late = bank().at(40)
    again = bank()
    again.at(3)
    assert torch.equal(again.at(40), late)
    assert torch.equal(bank().at(10**6), bank().at(10**6))  # far beyond any episode


def marked(horizon: int, samples: int) -> NoiseBank:
    """A bank whose numbers tell their places."""
    one = bank(horizon=horizon, samples=samples)
    places = torch.arange(one.values.numel(), dtype=torch.float32).view(
        one.values.shape
    )
    return NoiseBank(
        scale=SCALE,
        values=places,
        offset=one.offset,
        stride=one.stride,
        samples=samples,
    )


@pytest.mark.parametrize(("horizon", "samples"), [(2, 50), (50, 40), (7, 1)])
def test_runs_keep_to_their_parts_and_no_number_serves_a_sample_twice(
    horizon: int, samples: int
) -> None:
    one = marked(horizon, samples)
    part = 4 * samples
    for step in range(300):
        noise = one.at(step)
        assert bool((noise.diff(dim=2) == 1).all())
        owner = (noise // part).long()
        assert torch.equal(owner[..., 0], owner[..., -1])
        assert len(owner[..., 0].unique()) == 2 * horizon
        assert bool((owner[:, 1] >= horizon).all())
        assert bool((owner[:, 0] < horizon).all())


def test_runs_begin_everywhere_and_parts_change_hands() -> None:
    one = marked(5, 50)
    begin = torch.stack([one.at(step)[2, 0, 0] for step in range(600)]).long()
    assert set((begin // 200).tolist()) == set(range(5))
    # Also those of one moment, which is a time step less at each step.
    moment = torch.stack([one.at(step)[4 - step, 0, 0] for step in range(5)]).long()
    assert len((moment // 200).unique()) == 5
    assert (begin % 200).min() < 10
    assert (begin % 200).max() > 140


# Goals 6 m behind the robot, and in the turning circle on its left.
BEHIND, WITHIN = (7.0, 10.0), (13.0, 11.2)


@pytest.mark.parametrize(
    ("objective", "min_speed_mps", "wheelbase_m", "drives"),
    [
        # Half a turn of radius 0.73 m and 5 m back take 8.5 s at 0.85 m/s, 5 m in
        # reverse 5.9 s.
        ("travel_time", 0.0, 0.5, [(0.85, BEHIND, 12.0)]),
        ("goal_distance", -1.0, 0.5, [(0.85, BEHIND, 8.0)]),
        # At 0.35 m/s half a turn takes 7 s, and the horizon is 5 s.
        ("goal_distance", 0.0, 0.5, [(0.85, BEHIND, 12.0), (0.35, BEHIND, 26.0)]),
        # Dubins paths of 10.7 m, and of 8.3 m, away from the goal and back.
        ("travel_time", 0.0, 1.0, [(0.85, BEHIND, 16.0), (0.85, WITHIN, 13.0)]),
    ],
)
def test_a_bicycle_turns_to_any_goal(
    objective: str,
    min_speed_mps: float,
    wheelbase_m: float,
    drives: list[tuple[float, tuple[float, float], float]],
) -> None:
    robot = Bicycle(speed_mps=(min_speed_mps, 1.0), wheelbase_m=wheelbase_m)
    radius_m = 0.5 if wheelbase_m == 1 else 1.0
    cost = registry.make("objective", objective, robot=robot, goal_radius_m=radius_m)
    traversability, goals, max_s = zip(*drives, strict=True)
    ground = torch.tensor(traversability)[:, None, None].expand(-1, 40, 40)
    problem = factories.problem(
        ground, (13.0, 10.0), BEHIND, robot, cost, Rules(goal_radius_m=radius_m)
    )
    problem = with_start(problem, 13.0, 10.0, 0.0)
    problem = replace(problem, goal_m=torch.tensor(goals))
    planner = MPPI(replace(SMALL, samples=128, horizon_s=5.0))
    driven = drive(planner, problem, None, max(max_s))
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * len(drives)
    assert bool((0.1 * driven.steps <= torch.tensor(max_s)).all())


def test_turns_are_full_steering_for_some_of_the_time_and_then_straight() -> None:
    like = torch.zeros(1)
    assert [
        is_steered(robot) for robot in (Bicycle(), Unicycle(), DifferentialDrive())
    ] == [
        True,
        False,
        False,
    ]
    forward = turning_primitives(Bicycle(speed_mps=(0.2, 0.8)), 32, like)
    both = turning_primitives(Bicycle(speed_mps=(-0.5, 0.8)), 32, like)
    assert forward.shape == (32, 2, 34)
    assert both.shape == (32, 2, 102)
    assert torch.equal(both[..., :34], forward)
    assert bool((forward[:, 0] == 0.8).all())
    steering = forward[:, 1]
    assert (steering != 0).sum(0).tolist() == [*range(0, 33, 2)] * 2
    assert bool((steering.abs().diff(dim=0) <= 0).all())
    assert steering[0].tolist() == pytest.approx([0.0, *[-0.6] * 16, 0.0, *[0.6] * 16])
    assert bool((both[:, 0, 34:68] == -0.5).all())
    shunts = both[:, :, 68:]
    assert torch.equal(shunts[:, 0] == -0.5, shunts[:, 1] != 0)
    assert bool(((shunts[:, 0] == 0.8) | (shunts[:, 0] == -0.5)).all())


@dataclass
class Asked:
    """Fields that note on which cells they are drawn."""

    cells: torch.Tensor | None = None

    def sample(
        self, count: int, key: int, cells: torch.Tensor | None = None
    ) -> torch.Tensor:
        assert cells is not None
        self.cells = cells
        return torch.full((len(cells), count, *cells.shape[1:]), 0.5)

    def select(self, members: torch.Tensor) -> "Asked":
        return self


def test_fields_are_drawn_as_far_as_what_is_rolled_out() -> None:
    fields = Asked()
    problem = factories.problem(
        torch.full((1, 40, 40), 0.8), (1.25, 10.25), (13.0, 10.25)
    )
    problem = replace(problem, fields=fields)
    planner = MPPI(replace(SMALL, risk_on="cost", fields=10))
    planner.plan(first(problem), planner.init(problem, generator()))
    assert fields.cells is not None
    assert int(fields.cells[0, 20].sum()) == 3 + round((2.0 + 0.5) / 0.5)


def test_a_turn_replaces_only_a_mean_that_is_no_better_than_standing() -> None:
    """Goals behind, ahead of a robot at rest, ahead of one with a good mean, and behind
    on slow ground.
    """
    ground = torch.full((4, 40, 40), 0.85)
    ground[3] = 0.35  # half a turn takes 6.6 s, so that none pays within 5 s
    problem = factories.problem(ground, (13.0, 10.0), (7.0, 10.0), Bicycle())
    start = torch.tensor(
        [
            [13.0, 10.0, 0.0],
            [13.0, 10.0, math.pi],
            [13.0, 10.0, math.pi],
            [13.0, 10.0, 0.0],
        ]
    )
    problem = replace(problem, start=start)
    planner = MPPI(replace(SMALL, horizon_s=5.0))
    state = planner.init(problem, generator())
    mean = state.mean.clone()
    mean[2, :, 0] = 0.5
    state = replace(state, mean=mean)
    turned, follows = planner._mean_or_turns(
        first(problem), state, problem.goal_m, problem.padded_ground, None
    )
    assert follows.tolist() == [False, False, False, True]
    assert bool((turned[[0, 3], :, 0] == 1).all())
    # Half a turn takes π·0.73 m / 0.85 m/s = 2.7 s, and all of 5 s where λ̂ is 0.35.
    assert 20 <= int((turned[0, :, 1].abs() > 0).sum()) <= 34
    assert torch.equal(turned[2], mean[2])
    torch.testing.assert_close(turned[3, :, 1].abs(), torch.full((50,), 0.6))
    for member, chosen in enumerate(turned):
        alone = problem.select(torch.tensor([member]))
        kept = planner.select(state, torch.tensor([member]))
        single, _ = planner._mean_or_turns(
            first(alone), kept, alone.goal_m, alone.padded_ground, None
        )
        torch.testing.assert_close(single[0], chosen)


@pytest.mark.parametrize("goal", [BEHIND, WITHIN])
def test_actions_along_a_dubins_path_reach_the_goal_without_feedback(
    goal: tuple[float, float],
) -> None:
    robot = Bicycle(wheelbase_m=1.0)
    problem = factories.problem(
        torch.full((1, 40, 40), 0.35), (13.0, 10.0), goal, robot
    )
    problem = with_start(problem, 13.0, 10.0, 0.0)
    actions, turns = follow_dubins(
        problem, problem.start, problem.goal_m, problem.padded_ground, 400
    )
    state, nearest = problem.start, math.inf
    for action in actions.unbind(1):
        state = robot(state, action, torch.tensor([0.35]))
        nearest = min(nearest, float(torch.dist(state[0, :2], problem.goal_m[0])))
    assert bool(turns)
    assert nearest < 0.15  # a step is straight in the simulation, and turns at its end


def test_a_dubins_path_is_driven_as_it_is_until_the_robot_faces_the_goal() -> None:
    """Neither samples change it nor a mean that pays ends it."""
    problem = factories.problem(
        torch.full((1, 40, 40), 0.35), (13.0, 10.0), BEHIND, Bicycle()
    )
    problem, ahead = (
        with_start(problem, 13.0, 10.0, heading) for heading in (0.0, math.pi)
    )
    actions, _ = follow_dubins(
        problem, problem.start, problem.goal_m, problem.padded_ground, 50
    )
    planner = MPPI(replace(SMALL, horizon_s=5.0))
    chosen, after, _ = planner.plan(first(problem), planner.init(problem, generator()))
    torch.testing.assert_close(chosen, actions[:, 0])
    straight = replace(after, mean=after.mean * torch.tensor([1.0, 0.0]))
    assert bool(planner.plan(first(problem), straight)[1].on_dubins_path)
    assert not bool(
        planner.plan(first(ahead), replace(straight, problem=ahead))[1].on_dubins_path
    )


LEFT, RIGHT = (slice(21, None), slice(26, 28)), (slice(None, 19), slice(26, 28))


@pytest.mark.parametrize(
    ("sides", "immobile", "kept", "side"),
    [
        ((), None, (1, 1), 1),  # the goal is behind, to the left
        ((LEFT,), None, (1, 1), 1),  # slow ground is no obstacle
        ((LEFT,), Immobile(below=0.1), (1, 1), -1),
        ((LEFT, RIGHT), Immobile(below=0.1), (1, 1), None),
        ((LEFT,), Immobile(below=0.1), (1, 0), 1),  # on one of two fields
        ((LEFT,), Immobile(below=0.01), (1, 1), 1),
    ],
)
def test_a_dubins_path_keeps_to_ground_that_holds_the_robot(
    sides: tuple[Any, ...],
    immobile: Immobile | None,
    kept: tuple[int, int],
    side: int | None,
) -> None:
    rules = Rules(min_traversability=0.05, free_space=FreeSpace(above=0.0))
    fields = torch.full((2, 40, 40), 0.5)
    for place in sides:
        for field, soft in zip(fields, kept, strict=True):
            field[place] = 0.05 if soft else 0.5
    problem = factories.problem(
        fields[:1], (13.0, 10.0), (7.0, 10.5), Bicycle(), rules=rules
    )
    problem = replace(with_start(problem, 13.0, 10.0, 0.0), immobile=immobile)
    ground = pad_fields(problem, fields[None])
    actions, turns = follow_dubins(problem, problem.start, problem.goal_m, ground, 50)
    assert bool(turns) == (side is not None)
    assert side is None or actions[0, 0, 1].sign() == side
    closed = replace(problem, free=fields[:1] > 0.05)
    actions, turns = follow_dubins(
        closed, closed.start, closed.goal_m, pad_fields(closed, fields[None]), 50
    )
    free = {0: 1, 1: -1 if kept[0] else 1, 2: None}[len(sides)]
    assert bool(turns) == (free is not None)
    assert free is None or actions[0, 0, 1].sign() == free
