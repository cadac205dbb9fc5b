"""No function changes what it is given."""

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pytest
import torch

from benchnav.core import gridgraph, registry, rng
from benchnav.datagen.files.hdf5 import pack
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.load import load_recipe
from benchnav.datagen.schema import FIELDS, entry_digests
from benchnav.datagen.synth import appearance, elevation
from benchnav.datagen.synth.generate import generate
from benchnav.planning import risk
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.astar.dwa import DWAConfig, score, velocity_window
from benchnav.planning.problem import Problem
from benchnav.planning.world.outcome import Outcome, classify_standstill
from benchnav.planning.world.simulation import Simulation, end
from benchnav.planning.world.world import World
from tests import factories
from tests.core.test_mixture import random_mixture
from tests.factories import tiny_recipe
from tests.planning.planners.driving import rollout_cost


def same_after(call: Callable[[], object], *given: torch.Tensor | np.ndarray) -> None:
    before = [np.array(value, copy=True) for value in given]
    call()
    for kept, value in zip(before, given, strict=True):
        np.testing.assert_array_equal(kept, np.asarray(value))


@pytest.mark.parametrize("name", registry.names("risk"))
def test_risk_measures(name: str) -> None:
    mixture = random_mixture()
    given = (mixture.weights, mixture.means, mixture.stds)
    same_after(lambda: risk.apply(registry.make("risk", name), mixture), *given)


def test_mixture_methods() -> None:
    mixture, value = random_mixture(), torch.rand(2, 1, 6, dtype=torch.float64)
    given = (mixture.weights, mixture.means, mixture.stds, value)
    same_after(lambda: mixture.cdf(value), *given)
    same_after(lambda: mixture.log_prob(value), *given)


def test_datagen() -> None:
    z, class_id = (
        np.random.default_rng(0).random((2, 8, 8)),
        np.zeros((2, 8, 8), dtype=int),
    )
    light = appearance.light_direction(np.zeros(2), np.full(2, 0.5))
    classes = load_recipe("paper-v1").classes
    colours = np.full((2, 3, 8, 8), 99.0)
    same_after(
        lambda: elevation.inclination_deg(
            *elevation.horn_gradient(elevation.pad_missing(z), 0.5)
        ),
        z,
    )
    same_after(lambda: appearance.shade(z, z, light, 0.1), z, light)
    same_after(lambda: appearance.paint(colours, z), colours, z)
    same_after(lambda: appearance.class_bands(z, np.array([0.5, 0.5])), z)
    same_after(lambda: latent.latent_mean(class_id, z, classes), class_id, z)
    indices = np.array([0, 2, 3])
    same_after(lambda: generate(tiny_recipe(), "test/hg", indices), indices)
    same_after(lambda: rng.normal(1, indices, (3,)), indices)
    maps = generate(tiny_recipe(), "test/hg", np.arange(2))
    same_after(lambda: entry_digests(maps, FIELDS), *maps.values())
    entry = {"scenario": "hg", "maps": 2, "parts": []}
    same_after(lambda: pack(tiny_recipe(), "test/hg", entry, maps), *maps.values())


def maps_of(problem: Problem) -> tuple[torch.Tensor, ...]:
    """Every tensor of a problem."""
    held = [
        getattr(value, f.name)
        for value in (problem, problem.distribution, problem.observation)
        for f in fields(value)
    ]
    derived = (problem.padded_ground, problem.traversability, *problem.action_bounds)
    return (*(value for value in held if torch.is_tensor(value)), *derived)


def test_the_problem() -> None:
    problem = factories.problem(torch.rand(2, 16, 16))
    state, action = torch.rand(2, 5, 3), torch.rand(2, 5, 2)
    ground, target = problem.ground_at(state), problem.goal_m[:, None]
    given = (state, action, ground, target, *maps_of(problem))
    same_after(lambda: problem.stage_cost(state, action, ground, target), *given)
    same_after(lambda: problem.terminal_cost(state, target), *given)
    same_after(lambda: problem.select(torch.tensor([1])), *given)


def test_parts_of_planners() -> None:
    """Planners themselves are held to this by their contract."""
    problem = factories.problem(torch.rand(2, 16, 16))
    maps = maps_of(problem)
    same_after(lambda: astar.search(problem), *maps)
    costs, goals = astar.edge_costs(problem).numpy(), np.zeros((2, 16, 16), dtype=bool)
    same_after(lambda: gridgraph.cost_to_go(costs, goals, (16, 16)), costs, goals)
    mean, noise, target = torch.rand(2, 12, 2), torch.randn(12, 2, 5), problem.goal_m
    same_after(
        lambda: rollout_cost(problem, problem.start, mean, noise, target),
        mean,
        noise,
        *maps,
    )
    velocity, config = torch.zeros(2, 2), DWAConfig()
    same_after(lambda: velocity_window(problem, velocity, config), velocity, *maps)
    window = velocity_window(problem, velocity, config)
    same_after(
        lambda: score(problem, problem.start, window, target, config), window, *maps
    )


def test_the_world() -> None:
    problem = factories.problem(torch.rand(2, 16, 16))
    action, outcome = torch.full((2, 2), 5.0), torch.full((2,), int(Outcome.TIMEOUT))
    terrain = factories.terrain(torch.rand(2, 16, 16))
    truth = (
        terrain.truth.weights,
        terrain.truth.means,
        terrain.truth.stds,
        terrain.traversability,
    )
    simulation = Simulation(
        terrain, problem.task, World(), factories.places(problem.goal_m), 0, [0, 1]
    )
    now = simulation.init(problem.start)
    given = (now.state, now.outcome, now.step, action, *maps_of(problem), *truth)
    same_after(lambda: simulation.step(now, action), *given)
    same_after(lambda: simulation.unhindered(now, action), *given)
    same_after(
        lambda: end(now, torch.tensor([True, False]), Outcome.PLANNER_ERROR), *given
    )
    steps = torch.tensor([199, 199])
    track, driven = torch.zeros(2, 200, 2), torch.zeros(2, 199)
    same_after(
        lambda: classify_standstill(outcome, steps, track, driven, 0.1),
        outcome,
        steps,
        track,
        driven,
    )


def test_the_global_generators_are_left_alone() -> None:
    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002 - to see that nobody uses it
    before = torch.get_rng_state(), np.random.get_state()[1]  # noqa: NPY002
    generate(tiny_recipe(), "train", np.arange(2))
    ground = torch.full((2, 16, 16), 0.8)
    problem = factories.problem(ground)
    Simulation(
        factories.terrain(ground),
        problem.task,
        World(),
        factories.places(problem.goal_m),
        0,
        [0, 1],
    )
    assert torch.equal(before[0], torch.get_rng_state())
    np.testing.assert_array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002
