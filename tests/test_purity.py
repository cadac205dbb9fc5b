"""No function changes what it is given."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from benchnav import gridgraph, rng
from benchnav.datagen import appearance, elevation, latent
from benchnav.datagen.block import Block
from benchnav.datagen.generate import generate
from benchnav.datagen.scenario import load_recipe
from benchnav.datagen.schema import entry_digests
from benchnav.planning import astar, mppi
from benchnav.planning.dwa import DWAConfig, choose_velocity
from benchnav.planning.risk import NAMES, RiskSetting
from benchnav.planning.simulation import Simulation, fail, tell_stuck
from tests import factories
from tests.factories import tiny_recipe
from tests.test_mixture import random_mixture


def same_after(call: Callable[[], object], *given: torch.Tensor | np.ndarray) -> None:
    before = [np.array(value, copy=True) for value in given]
    call()
    for kept, value in zip(before, given, strict=True):
        np.testing.assert_array_equal(kept, np.asarray(value))


@pytest.mark.parametrize("name", NAMES)
def test_risk_settings(name: str) -> None:
    mixture = random_mixture()
    given = (mixture.weights, mixture.means, mixture.stds)
    same_after(lambda: RiskSetting(name).apply(mixture), *given)


def test_mixture_methods() -> None:
    mixture, value = random_mixture(), torch.rand(2, 1, 6, dtype=torch.float64)
    given = (mixture.weights, mixture.means, mixture.stds, value)
    same_after(lambda: mixture.cdf(value), *given)
    same_after(lambda: mixture.log_prob(value), *given)
    same_after(lambda: mixture.sample(3, torch.Generator()), *given)


def test_datagen() -> None:
    z, class_id = np.random.default_rng(0).random((2, 8, 8)), np.zeros((2, 8, 8), dtype=int)
    light = appearance.light_direction(np.zeros(2), np.full(2, 0.5))
    classes = load_recipe("paper-v1").classes
    colours = np.full((10, 3), 99.0)
    same_after(lambda: elevation.slope_deg(z, 0.5), z)
    same_after(lambda: appearance.shade(z, 0.5, light, 0.1), z, light)
    same_after(lambda: appearance.paint(class_id, colours, z), class_id, colours, z)
    same_after(lambda: appearance.class_bands(z, np.array([0.5, 0.5])), z)
    same_after(lambda: latent.latent_mean(class_id, z, classes), class_id, z)
    indices = np.array([0, 2, 3])
    same_after(lambda: generate(tiny_recipe(), "test/hg", indices), indices)
    same_after(lambda: rng.normal(1, indices, (3,)), indices)
    maps = generate(tiny_recipe(), "test/hg", np.arange(2))
    same_after(lambda: entry_digests(maps), *maps.values())
    same_after(lambda: Block.of(maps), *maps.values())


def test_planning() -> None:
    problem = factories.problem(torch.rand(2, 16, 16))
    maps = (problem.elevation_m, problem.traversability, problem.start, problem.goal_m)
    same_after(lambda: astar.search(problem), *maps)
    costs, goals = astar.edge_costs(problem), np.zeros((2, 16, 16), dtype=bool)
    same_after(lambda: gridgraph.cost_to_go(costs, goals, (16, 16)), costs, goals)
    mean, noise = torch.rand(2, 12, 2), torch.randn(12, 2, 5)
    same_after(lambda: mppi.rollout_cost(problem, problem.start, mean, noise), mean, noise, *maps)
    velocity = torch.zeros(2, 2)
    same_after(
        lambda: choose_velocity(problem, problem.start, velocity, problem.goal_m, DWAConfig()),
        velocity,
        *maps,
    )
    action, outcome = torch.full((2, 2), 5.0), torch.tensor([2, 2])
    terrain = factories.terrain(torch.rand(2, 16, 16))
    simulation = Simulation(terrain, problem.dynamics, problem.goal_m, 0, [0, 1])
    now = simulation.init(problem.start)
    truth = (terrain.traversability_mean, terrain.traversability_std, terrain.traversability)
    same_after(lambda: simulation.step(now, action), now.state, now.outcome, now.step, action, *maps, *truth)
    same_after(lambda: fail(now, torch.tensor([True, False])), now.outcome)
    track = torch.zeros(2, 200, 2)
    same_after(lambda: tell_stuck(outcome, track, 0.1), outcome, track)


def test_the_global_generators_are_left_alone() -> None:
    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002 - to see that nobody uses it
    before = torch.get_rng_state(), np.random.get_state()[1]  # noqa: NPY002
    problem = factories.problem(torch.full((1, 16, 16), 0.8))
    planner = mppi.MPPI(mppi.MPPIConfig(samples=32, horizon=5))
    planner.plan(problem.start, planner.init(problem, torch.Generator().manual_seed(1)))
    generate(tiny_recipe(), "train", np.arange(2))
    random_mixture().sample(3, torch.Generator())
    assert torch.equal(before[0], torch.get_rng_state())
    np.testing.assert_array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002
