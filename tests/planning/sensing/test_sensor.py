from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.sensor import (
    MIN_STD,
    Contact,
    Measurement,
    NoiseKey,
    Probe,
)
from tests.planning.sensing import made

BATCH, HEIGHT, WIDTH = 3, 12, 14
KEYS = (11, 12, 13)
STATES = torch.tensor(
    [[2.3, 1.1, 0.0], [0.2, 5.9, 1.0], [6.9, 0.1, 2.0]], dtype=torch.float64
)


@pytest.fixture
def ground() -> tuple[Terrain, torch.Tensor]:
    truth = made.mixture(BATCH, HEIGHT, WIDTH)
    covariance = made.covariance(HEIGHT, WIDTH)
    field = truth.from_normal(made.scores(covariance, BATCH))
    return made.terrain(truth, field), field


def sense(
    sensor: Contact | Probe, ground: tuple[Terrain, torch.Tensor], step: int = 3
) -> Measurement:
    return sensor.sense(*ground, STATES, NoiseKey(KEYS, step))


def test_contact_is_the_λ_of_the_robots_cell_as_it_is(
    ground: tuple[Terrain, torch.Tensor],
) -> None:
    sensed = sense(Contact(), ground)
    assert sensed.mask.nonzero().tolist() == [[0, 2, 4], [1, 11, 0], [2, 0, 13]]
    assert torch.equal(sensed.traversability[sensed.mask], ground[1][sensed.mask])
    assert (sensed.std[sensed.mask] == MIN_STD).all()


def test_a_robot_off_the_map_senses_nothing_by_contact(
    ground: tuple[Terrain, torch.Tensor],
) -> None:
    away = STATES.clone()
    away[1, 0] = -0.1
    sensed = Contact().sense(*ground, away, NoiseKey(KEYS, 0))
    assert sensed.mask.flatten(1).any(1).tolist() == [True, False, True]


@pytest.mark.parametrize("radius_m", [0.3, 1.0, 2.5])
def test_a_probe_senses_the_cells_whose_centres_are_near(
    radius_m: float, ground: tuple[Terrain, torch.Tensor]
) -> None:
    mask = sense(Probe(radius_m=radius_m), ground).mask
    for own, (x, y, _) in enumerate(STATES.tolist()):
        for row in range(HEIGHT):
            for column in range(WIDTH):
                near = (
                    np.hypot((column + 0.5) * 0.5 - x, (row + 0.5) * 0.5 - y)
                    <= radius_m
                )
                assert bool(mask[own, row, column]) == near


def test_the_noise_of_a_probe_is_normal_in_scores() -> None:
    truth = made.mixture(BATCH, HEIGHT, WIDTH, atoms=False)
    field = truth.from_normal(torch.zeros(BATCH, HEIGHT, WIDTH, dtype=torch.float64))
    found = []
    for step in range(80):
        sensed = Probe(2.0, 0.3).sense(
            made.terrain(truth, field), field, STATES, NoiseKey(KEYS, step)
        )
        assert (sensed.std[sensed.mask] == 0.3).all()
        score, _ = truth.at(sensed.mask).to_normal(
            sensed.traversability[sensed.mask][None]
        )
        found.append(score.flatten())
    noise = torch.cat(found).numpy()
    assert len(noise) > 3000
    assert stats.kstest(noise / 0.3, "norm").pvalue > 1e-3


def test_an_atom_is_read_as_it_is_and_ground_beside_it_may_be_mistaken_for_it() -> None:
    truth = made.mixture(BATCH, HEIGHT, WIDTH)
    _, upper = truth.to_normal(torch.zeros(BATCH, HEIGHT, WIDTH, dtype=torch.float64))
    for value in (0.0, 1.0):
        field = torch.full((BATCH, HEIGHT, WIDTH), value, dtype=torch.float64)
        sensed = Probe(2.0, 0.5).sense(
            made.terrain(truth, field), field, STATES, NoiseKey(KEYS, 0)
        )
        assert bool((sensed.traversability[sensed.mask] == value).all())
    field = truth.from_normal(upper + 0.1)
    told = []
    for step in range(80):
        sensed = Probe(2.0, 0.1).sense(
            made.terrain(truth, field), field, STATES, NoiseKey(KEYS, step)
        )
        told.append(sensed.traversability[sensed.mask] == 0)
    assert float(torch.cat(told).double().mean()) == pytest.approx(
        stats.norm.cdf(-1), abs=0.015
    )


def test_what_many_looks_of_a_probe_say_of_the_cells_around_holds_as_often_as_it_should() -> (
    None
):
    """Of λ in the belief's central 90 %, where atoms are looked at again and again."""
    batch, size = 300, 13
    covariance, ground = made.covariance(size, size), made.mixture(batch, size, size)
    share = torch.full_like(ground.weights[:, :1], 0.3)
    low, high = ground.means.split(1, 1)
    truth = TraversabilityMixture(
        torch.cat((share, 1 - share), 1), torch.cat((low - 0.1, high), 1), ground.stds
    )
    field = truth.from_normal(made.scores(covariance, batch))
    assert 0.1 < float((field == 0).double().mean()) < 0.2
    terrain, belief = made.terrain(truth, field), Copula()
    states = torch.tensor([[3.25, 3.25, 0.0]] * batch, dtype=torch.float64)
    known = belief.init(truth, covariance)
    for step in range(12):
        sensed = Probe(1.0, 0.1).sense(
            terrain, field, states, NoiseKey(range(batch), step)
        )
        known = belief.update(known, sensed)
    row, column = (torch.arange(size) - 6 for _ in range(2))
    near = torch.hypot(row[:, None].double(), column[None].double()) <= 4
    cells = near & ~sensed.mask
    low, high = belief.at(known, cells).cdf_limits(field[cells][None])
    rank = torch.rand(
        low.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    inside = (torch.lerp(low.double(), high.double(), rank)[0] - 0.5).abs() <= 0.45
    by_map = inside.double().view(batch, -1).mean(1)
    error = 3 * float(by_map.std()) / batch**0.5
    assert error < 0.02
    assert float(by_map.mean()) == pytest.approx(0.9, abs=error)


def test_noise_is_of_the_episode_the_cell_and_the_step_alone(
    ground: tuple[Terrain, torch.Tensor],
) -> None:
    both, wide = sense(Probe(1.0), ground), sense(Probe(2.0), ground)
    assert torch.equal(wide.traversability[both.mask], both.traversability[both.mask])
    order = torch.tensor([2, 0])
    some = Probe(1.0).sense(
        ground[0].select(order),
        ground[1][order],
        STATES[order],
        NoiseKey([KEYS[2], KEYS[0]], 3),
    )
    assert torch.equal(
        some.traversability[some.mask], both.traversability[order][some.mask]
    )
    later = sense(Probe(1.0), ground, step=4)
    assert not torch.equal(
        later.traversability[later.mask], both.traversability[both.mask]
    )
    other = Probe(1.0).sense(*ground, STATES, NoiseKey([KEYS[1], KEYS[1], KEYS[2]], 3))
    changed = (other.traversability != both.traversability)[
        both.mask.nonzero(as_tuple=True)
    ]
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
    again = sense(
        sensor, (replace(terrain, truth=truth, traversability=elsewhere), elsewhere)
    )
    torch.testing.assert_close(
        again.traversability, sensed.traversability, equal_nan=True, rtol=0, atol=0
    )


@pytest.mark.parametrize(
    "wrong", [{"radius_m": 0.0}, {"noise_std": 1e-4}, {"noise_std": float("inf")}]
)
def test_probes_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Probe(**wrong)
