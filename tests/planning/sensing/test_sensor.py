from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from benchnav.core.errors import ConfigError
from benchnav.core.terrain import Terrain
from benchnav.planning.sensing.sensor import LEAST_STD, Contact, Moment, Probe, Sensed
from tests.planning.sensing import made

BATCH, HEIGHT, WIDTH = 3, 12, 14
KEYS = (11, 12, 13)
STATES = torch.tensor([[2.3, 1.1, 0.0], [0.2, 5.9, 1.0], [6.9, 0.1, 2.0]], dtype=torch.float64)


@pytest.fixture
def ground() -> tuple[Terrain, torch.Tensor]:
    truth = made.mixture(BATCH, HEIGHT, WIDTH)
    law = made.law(HEIGHT, WIDTH)
    field = truth.from_normal(made.scores(law, BATCH))
    return made.terrain(truth, field), field


def sense(sensor: Contact | Probe, ground: tuple[Terrain, torch.Tensor], step: int = 3) -> Sensed:
    return sensor.sense(*ground, STATES, Moment(KEYS, step))


def test_contact_is_the_λ_of_the_robots_cell_as_it_is(ground: tuple[Terrain, torch.Tensor]) -> None:
    sensed = sense(Contact(), ground)
    assert sensed.mask.nonzero().tolist() == [[0, 2, 4], [1, 11, 0], [2, 0, 13]]
    assert torch.equal(sensed.traversability[sensed.mask], ground[1][sensed.mask])
    assert (sensed.std[sensed.mask] == LEAST_STD).all()


def test_a_robot_off_the_map_senses_nothing_by_contact(ground: tuple[Terrain, torch.Tensor]) -> None:
    away = STATES.clone()
    away[1, 0] = -0.1
    sensed = Contact().sense(*ground, away, Moment(KEYS, 0))
    assert sensed.mask.flatten(1).any(1).tolist() == [True, False, True]


@pytest.mark.parametrize("radius_m", [0.3, 1.0, 2.5])
def test_a_probe_senses_the_cells_whose_centres_are_near(
    radius_m: float, ground: tuple[Terrain, torch.Tensor]
) -> None:
    mask = sense(Probe(radius_m=radius_m), ground).mask
    for own, (x, y, _) in enumerate(STATES.tolist()):
        for row in range(HEIGHT):
            for column in range(WIDTH):
                near = np.hypot((column + 0.5) * 0.5 - x, (row + 0.5) * 0.5 - y) <= radius_m
                assert bool(mask[own, row, column]) == near


def test_the_noise_of_a_probe_is_normal_in_scores() -> None:
    truth = made.mixture(BATCH, HEIGHT, WIDTH, atoms=False)
    field = truth.from_normal(torch.zeros(BATCH, HEIGHT, WIDTH, dtype=torch.float64))
    found = []
    for step in range(80):
        sensed = Probe(2.0, 0.3).sense(made.terrain(truth, field), field, STATES, Moment(KEYS, step))
        assert (sensed.std[sensed.mask] == 0.3).all()
        score, _ = truth.at(sensed.mask).to_normal(sensed.traversability[sensed.mask][None])
        found.append(score.flatten())
    noise = torch.cat(found).numpy()
    assert len(noise) > 3000
    assert stats.kstest(noise / 0.3, "norm").pvalue > 1e-3


def test_within_an_atom_a_probe_takes_any_rank() -> None:
    truth = made.mixture(BATCH, HEIGHT, WIDTH)
    field = torch.zeros(BATCH, HEIGHT, WIDTH, dtype=torch.float64)
    terrain = made.terrain(truth, field)
    told = [
        sensed.traversability[sensed.mask]
        for step in range(80)
        for sensed in (Probe(2.0, 0.1).sense(terrain, field, STATES, Moment(KEYS, step)),)
    ]
    _, upper = truth.to_normal(field)
    # A rank under the atom's end that noise lifts over it is no longer 0: P(z + 0.1 ε > b | z < b).
    rng, ends = np.random.default_rng(0), upper[Probe(2.0)._near(terrain, STATES)].numpy()
    drawn = stats.truncnorm.rvs(-np.inf, ends, size=(2000, len(ends)), random_state=rng)
    expected = (drawn + 0.1 * rng.standard_normal(drawn.shape) > ends).mean()
    share = float((torch.cat(told) > 0).double().mean())
    assert 0.02 < share < 0.95
    assert share == pytest.approx(expected, abs=0.015)


def test_noise_is_of_the_episode_the_cell_and_the_step_alone(ground: tuple[Terrain, torch.Tensor]) -> None:
    both, wide = sense(Probe(1.0), ground), sense(Probe(2.0), ground)
    assert torch.equal(wide.traversability[both.mask], both.traversability[both.mask])
    order = torch.tensor([2, 0])
    some = Probe(1.0).sense(
        ground[0].select(order), ground[1][order], STATES[order], Moment([KEYS[2], KEYS[0]], 3)
    )
    assert torch.equal(some.traversability[some.mask], both.traversability[order][some.mask])
    later = sense(Probe(1.0), ground, step=4)
    assert not torch.equal(later.traversability[later.mask], both.traversability[both.mask])
    other = Probe(1.0).sense(*ground, STATES, Moment([KEYS[1], KEYS[1], KEYS[2]], 3))
    changed = (other.traversability != both.traversability)[both.mask.nonzero(as_tuple=True)]
    assert changed.any()


@pytest.mark.parametrize("sensor", [Contact(), Probe(1.0)])
def test_nothing_beyond_what_is_sensed_tells(
    sensor: Contact | Probe, ground: tuple[Terrain, torch.Tensor]
) -> None:
    terrain, field = ground
    sensed = sense(sensor, ground)
    other = made.mixture(BATCH, HEIGHT, WIDTH, seed=5)
    keep = sensed.mask[:, None]
    truth = replace(
        terrain.truth,
        weights=torch.where(keep, terrain.truth.weights, other.weights),
        means=torch.where(keep, terrain.truth.means, other.means),
    )
    elsewhere = torch.where(sensed.mask, field, 1 - field)
    again = sense(sensor, (replace(terrain, truth=truth, traversability=elsewhere), elsewhere))
    torch.testing.assert_close(again.traversability, sensed.traversability, equal_nan=True, rtol=0, atol=0)


@pytest.mark.parametrize("wrong", [{"radius_m": 0.0}, {"noise_std": 1e-4}, {"noise_std": float("inf")}])
def test_probes_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Probe(**wrong)
