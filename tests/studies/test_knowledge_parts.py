"""The controls of the study of knowledge: what they tell, and that they drive."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchnav import Terrain
from benchnav.core import registry
from benchnav.planning import Measurement, NoiseKey, Probe, Problem
from benchnav.planning.planners.astar import astar
from benchnav.planning.world.outcome import Outcome
from tests import factories
from tests.planning.planners.driving import drive
from tests.planning.sensing import made

PARTS = f"{Path(__file__).parents[2]}/studies/knowledge/parts.py"
BATCH, SIZE = 40, 24
KEYS = tuple(range(BATCH))
STATES = torch.tensor([[6.1, 5.8, 0.0]]).expand(BATCH, 3)


@pytest.fixture(scope="module")
def ground() -> tuple[Terrain, Tensor]:
    truth = made.mixture(BATCH, SIZE, SIZE, atoms=False)
    field = truth.from_normal(
        made.scores(made.covariance(SIZE, SIZE, 1.0), BATCH, seed=5)
    )
    return made.terrain(truth, field), field


def elsewhere(**options: Any) -> Probe:
    made: Probe = registry.make(
        "ground", {"part": f"{PARTS}:Elsewhere", "options": options}
    )
    return made


def sense(
    sensor: Probe,
    ground: tuple[Terrain, Tensor],
    keys: tuple[int, ...] = KEYS,
    step: int = 0,
) -> Measurement:
    return sensor.sense(*ground, STATES[: len(keys)], NoiseKey(keys, step))


def scores(sensed: Measurement, terrain: Terrain) -> Tensor:
    """Normal scores of what is sensed, a row an episode."""
    return (
        terrain.truth.at(sensed.mask)
        .to_normal(sensed.traversability[sensed.mask][None])[0]
        .view(BATCH, -1)
    )


def test_elsewhere_tells_a_draw_of_the_same_law_that_has_nothing_to_do_with_the_field(
    ground: tuple[Terrain, Tensor],
) -> None:
    sensor = elsewhere(radius_m=2.5, noise_std=0.001, correlation_m=1.0)
    told = scores(sense(sensor, ground), ground[0])
    true = scores(sense(Probe(2.5, noise_std=0.001), ground), ground[0])
    # Some 4 independent places in each of 40 episodes.
    assert abs(np.corrcoef(told.flatten(), true.flatten())[0, 1]) < 0.2
    assert float(told.mean()) == pytest.approx(0, abs=0.25)
    assert float(told.std()) == pytest.approx(1, abs=0.15)
    # Neighbouring cells of one row are correlated by exp(−0.5² / 2ℓ²).
    for length_m, expected in ((1.0, 0.88), (0.0, 0.0)):
        own = sense(
            elsewhere(radius_m=2.5, noise_std=0.001, correlation_m=length_m), ground
        )
        drawn = torch.full(own.mask.shape, torch.nan, dtype=torch.float64)
        drawn[own.mask] = scores(own, ground[0]).flatten()
        pairs = torch.stack((drawn[:, :, 1:].flatten(), drawn[:, :, :-1].flatten()))
        assert np.corrcoef(pairs[:, ~pairs.isnan().any(0)])[0, 1] == pytest.approx(
            expected, abs=0.06
        )


def test_elsewhere_is_one_draw_an_episode_by_its_key_and_looks_at_no_field(
    ground: tuple[Terrain, Tensor],
) -> None:
    sensor, (terrain, field) = elsewhere(radius_m=2.0, noise_std=0.001), ground
    told = sense(sensor, ground).traversability
    later = sense(sensor, ground, step=7).traversability
    # but for the noise
    torch.testing.assert_close(told, later, atol=0.01, rtol=0, equal_nan=True)
    other = sense(sensor, (terrain, torch.rand_like(field)))
    assert torch.equal(other.traversability.nan_to_num(-1), told.nan_to_num(-1))
    # One episode alone meets what it met among all, another key another draw.
    own = torch.tensor([3])
    for key, same in ((3, True), (99, False)):
        alone = sensor.sense(
            terrain.select(own), field[own], STATES[own], NoiseKey((key,), 0)
        ).traversability
        assert torch.equal(alone.nan_to_num(-1), told[own].nan_to_num(-1)) is same


def test_revising_searches_each_half_second_and_drives_as_if_it_had_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ground = torch.full((2, 16, 20), 0.85)
    ground[0, 4:16, 8:10] = 0.2
    posed = factories.problem(ground, goal=(8.25, 6.25))
    plain = drive(registry.make("planner", "astar_dwa"), posed)
    searched, whole = [], astar.search

    def search(problem: Problem, costs: Any = None) -> astar.CostToGo:
        searched.append(len(problem))
        return whole(problem, costs)

    monkeypatch.setattr(astar, "search", search)
    driven = drive(registry.make("planner", f"{PARTS}:Revising"), posed)
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * 2
    assert torch.equal(driven.states, plain.states)
    steps = driven.actions.shape[1]
    assert searched == [2] * (1 + -(-steps // 5))
