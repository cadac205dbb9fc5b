from dataclasses import replace

import pytest
import torch

from benchnav import rng
from benchnav.errors import ConfigError
from benchnav.planning.dynamics import Unicycle
from benchnav.planning.objective import GoalDistance
from benchnav.planning.risk import RiskSetting
from benchnav.planning.simulation import Outcome, Simulation, SimulationConfig, fail, tell_stuck
from tests import factories
from tests.test_mixture import random_mixture

KEY = rng.stream_key(0, "luck")
AHEAD = torch.tensor([[1.0, 0.0]])


def simulation(
    mean: torch.Tensor, goal: tuple[float, float], std: float = 0.1, **config: object
) -> Simulation:
    goals = torch.tensor([goal] * len(mean))
    settings = SimulationConfig(**config)  # type: ignore[arg-type]
    return Simulation(factories.terrain(mean, std), Unicycle(), goals, KEY, range(len(mean)), settings)


def test_unicycle_is_the_papers_equation() -> None:
    state, action = torch.tensor([[1.0, 2.0, 0.5]]), torch.tensor([[0.8, -0.4]])
    moved = Unicycle()(state, action, torch.tensor([0.5]))
    expected = [1 + 0.1 * 0.5 * 0.8 * 0.87758256, 2 + 0.1 * 0.5 * 0.8 * 0.47942554, 0.5 - 0.1 * 0.5 * 0.4]
    assert moved[0].tolist() == pytest.approx(expected)
    assert state[0].tolist() == [1.0, 2.0, 0.5]


def test_objective_is_distance_and_penalty() -> None:
    state = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 1.0]])
    cost = GoalDistance().stage(state, AHEAD, torch.tensor([0.31, 0.3]), torch.tensor([[3.0, 4.0]]))
    assert cost.tolist() == pytest.approx([5.0, 1e4])


def test_noise_is_resampled_with_the_latent_distribution_and_keyed_by_instance_and_step() -> None:
    sim = simulation(torch.full((40, 16, 16), 0.5), (90.0, 90.0))
    now = sim.init(torch.tensor([[4.0, 4.0, 0.0]] * 40))
    still = torch.zeros(40, 2)
    met = []
    for _ in range(200):
        now, traversability = sim.step(now, still)
        met.append(traversability)
    drawn = torch.stack(met)
    assert drawn.mean().item() == pytest.approx(0.5, abs=0.005)
    assert drawn.std().item() == pytest.approx(0.1, abs=0.005)
    other = simulation(torch.full((40, 16, 16), 0.5), (90.0, 90.0))
    alone = Simulation(
        factories.terrain(torch.full((1, 16, 16), 0.5)), Unicycle(), torch.tensor([[90.0, 90.0]]), KEY, [7]
    )
    _, first = other.step(other.init(torch.zeros(40, 3) + 4), still)
    _, seventh = alone.step(alone.init(torch.zeros(1, 3) + 4), still[:1])
    assert torch.equal(first, drawn[0])
    assert seventh[0] == drawn[0, 7]


def test_another_time_budget_leaves_the_luck_as_it_is() -> None:
    still, start = torch.zeros(2, 2), torch.zeros(2, 3) + 4
    met = []
    for budget in (10.0, 100.0):
        sim = simulation(torch.full((2, 16, 16), 0.5), (90.0, 90.0), time_budget_s=budget)
        now, first = sim.step(sim.init(start), still)
        _, second = sim.step(now, still)
        met.append(torch.stack((first, second)))
    assert torch.equal(met[0], met[1])
    assert len(met[0].unique()) == 4


@pytest.mark.parametrize("budget", [0.0, 0.01, float("inf"), float("nan")])
def test_a_time_budget_without_a_step_is_refused(budget: float) -> None:
    with pytest.raises(ConfigError, match="time_budget_s"):
        simulation(torch.full((1, 16, 16), 0.5), (90.0, 90.0), time_budget_s=budget)


def test_traversability_is_clipped_to_its_range() -> None:
    sim = simulation(torch.stack([torch.full((16, 16), v) for v in [1.0, 0.0] * 20]), (90.0, 90.0))
    _, met = sim.step(sim.init(torch.zeros(40, 3) + 4), torch.zeros(40, 2))
    assert met.min() == 0
    assert met.max() == 1


def test_frozen_noise_is_the_maps_realised_traversability() -> None:
    mean = torch.rand(1, 16, 16)
    sim = simulation(mean, (90.0, 90.0), noise="frozen")
    now, met = sim.step(sim.init(torch.tensor([[3.3, 1.2, 0.0]])), AHEAD)
    assert met[0] == mean[0, 2, 6]
    assert now.state[0, 0].item() == pytest.approx(3.3 + 0.1 * mean[0, 2, 6].item())


def test_frozen_noise_needs_every_cell_observed() -> None:
    terrain = factories.terrain(torch.full((1, 16, 16), 0.5), 0.1)
    holed = terrain.traversability.clone()
    holed[0, 3, 3] = torch.nan
    terrain = replace(terrain, traversability=holed)
    build = (terrain, Unicycle(), torch.ones(1, 2), KEY, range(1))
    Simulation(*build, SimulationConfig(noise="resampled"))
    with pytest.raises(ConfigError, match="not observed"):
        Simulation(*build, SimulationConfig(noise="frozen"))


def test_outcomes() -> None:
    ground = torch.stack([torch.full((16, 16), v) for v in (1.0, 1.0, 0.0, 1.0)])
    goals = torch.tensor([[3.5, 4.0], [-5.0, 4.0], [7.0, 4.0], [7.0, 4.0]])
    sim = Simulation(
        factories.terrain(ground, 0.0), Unicycle(), goals, KEY, range(4), SimulationConfig(time_budget_s=12.0)
    )
    start = torch.tensor([[2.0, 4.0, 0.0], [0.95, 4.0, 3.1415927], [2.0, 4.0, 0.0], [2.0, 4.0, 0.0]])
    action = torch.tensor([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    now, track = sim.init(start), []
    while now.running.any():
        track.append(now.state[:, :2])
        now, _ = sim.step(now, action)
    outcome = tell_stuck(now.outcome, torch.stack([*track, now.state[:, :2]], dim=1), 0.1)
    assert outcome.tolist() == [Outcome.SUCCESS, Outcome.OUT_OF_BOUNDS, Outcome.STUCK, Outcome.TIMEOUT]
    assert now.step.tolist() == [6, 10, 120, 120]


def test_an_ended_episode_stands_still_and_failures_end_only_running_ones() -> None:
    sim = simulation(torch.full((2, 16, 16), 1.0), (2.5, 4.0), std=0.0)
    now = sim.init(torch.tensor([[2.0, 4.0, 0.0], [5.0, 4.0, 0.0]]))
    now, _ = sim.step(now, AHEAD.expand(2, 2))
    assert now.outcome.tolist() == [Outcome.SUCCESS, Outcome.RUNNING]
    ended = fail(now, torch.tensor([True, True]))
    assert ended.outcome.tolist() == [Outcome.SUCCESS, Outcome.PLANNER_FAILURE]
    later, _ = sim.step(ended, AHEAD.expand(2, 2))
    assert torch.equal(later.state, now.state)
    assert later.step.tolist() == [1, 1]


def test_actions_are_clipped_to_the_bounds() -> None:
    sim = simulation(torch.full((1, 16, 16), 1.0), (90.0, 90.0), std=0.0)
    now, _ = sim.step(sim.init(torch.tensor([[2.0, 4.0, 0.0]])), torch.tensor([[50.0, -50.0]]))
    assert now.state[0].tolist() == pytest.approx([2.1, 4.0, -0.1])


def test_risk_settings_read_write_and_apply() -> None:
    mixture = random_mixture()
    for text, expected in (
        ("cvar", mixture.cvar(0.9)),
        ("cvar:0.5", mixture.cvar(0.5)),
        ("var:0.95", mixture.var(0.95)),
        ("mean", mixture.mean()),
        ("single-class", mixture.most_likely().cvar(0.9)),
    ):
        setting = RiskSetting.parse(text)
        assert torch.equal(setting.apply(mixture), expected)
    for bad in ("cvr", "cvar:1", "cvar:x", "mean:0.5", ""):
        with pytest.raises(ConfigError):
            RiskSetting.parse(bad)
