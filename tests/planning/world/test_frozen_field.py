"""Frozen λ: marginals, correlation, keys, and drawing again where no way is left."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from benchnav.core import rng
from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.planning.world.realisation import draw_frozen, joined
from benchnav.planning.world.world import Immobile, Places, World
from tests import factories

KEY = rng.stream_key(0, "noise")
FREE = World(noise="frozen")
IMMOBILISING = World(noise="frozen", immobile=Immobile(below=0.1))


def ground(batch: int, *components: tuple[float, float, float], size: int = 16) -> Terrain:
    """Flat ground with the same mixture of (weight, mean, std) in each cell."""
    columns = torch.tensor(components).T[:, None, :, None, None]
    weights, means, stds = (c.expand(batch, -1, size, size).clone() for c in columns)
    made = factories.terrain(torch.full((batch, size, size), 0.5))
    return replace(made, truth=TraversabilityMixture(weights, means, stds, (0,) * len(components)))


def across(batch: int, size: int = 16) -> Places:
    """From one corner to the other."""
    start, goal = torch.full((batch, 2), 1.25), torch.full((batch, 2), 0.5 * size - 1.25)
    return factories.places(goal, start)


SOFT = ((0.9, 0.8, 0.1), (0.1, 0.05, 0.05))


def test_marginals_are_each_cells_own_distribution() -> None:
    """Before any field is rejected, pooled over realisations, in two cells of different ground."""
    terrain = ground(1, *SOFT)
    terrain.truth.means[:, 0, 8:] = 0.5
    draws = [draw_frozen(terrain, FREE, across(1), KEY, [i])[0][0] for i in range(2000)]
    field = torch.stack(draws).double().numpy()
    for row in (3, 12):
        truth = terrain.truth
        cell = (t[:, :, row : row + 1, :1].double() for t in (truth.weights, truth.means, truth.stds))
        mixture = TraversabilityMixture(*cell)
        drawn = field[:, row, 5]
        assert (drawn == 0).mean() == pytest.approx(float(mixture.cdf(0.0)), abs=0.01)
        inside = drawn[(drawn > 0) & (drawn < 1)]
        low, high = float(mixture.cdf(0.0)), 1 - float(mixture.chance(1.0))

        def share(value: np.ndarray, mixture: TraversabilityMixture = mixture) -> np.ndarray:
            return np.array([float(mixture.cdf(float(v))) for v in np.atleast_1d(value)])

        found = stats.kstest(inside, lambda v, low=low, high=high: (share(v) - low) / (high - low))
        assert found.pvalue > 1e-3


@pytest.mark.parametrize("correlation_m", [0.5, 1.5])
def test_the_correlation_of_the_gaussian_field_is_that_of_the_world(correlation_m: float) -> None:
    terrain, world = ground(1, (1.0, 0.5, 0.05)), replace(FREE, correlation_m=correlation_m)
    draws = [draw_frozen(terrain, world, across(1), KEY, [i])[0][0] for i in range(1500)]
    normal = (torch.stack(draws).double() - 0.5) / 0.05
    for rows, columns in ((1, 0), (0, 2), (3, 0), (2, 2), (0, 8)):
        other = normal[:, rows:, columns:]
        here = normal[:, : other.shape[1], : other.shape[2]]
        distance = 0.5 * np.hypot(rows, columns)
        expected = np.exp(-(distance**2) / (2 * correlation_m**2))
        assert float((here * other).mean()) == pytest.approx(expected, abs=0.03)


def test_a_field_is_keyed_by_root_and_map_whatever_the_batch() -> None:
    terrain = ground(4, *SOFT)
    together, _ = draw_frozen(terrain, IMMOBILISING, across(4), KEY, [3, 5, 7, 9])
    alone, _ = draw_frozen(terrain.select(torch.tensor([2])), IMMOBILISING, across(1), KEY, [7])
    assert torch.equal(alone[0], together[2])
    assert len({float(values.sum()) for values in together}) == 4
    other, _ = draw_frozen(terrain, IMMOBILISING, across(4), rng.stream_key(1, "noise"), [3, 5, 7, 9])
    assert not (other == together).flatten(1).all(dim=1).any()


def test_another_correlation_filters_the_same_white_noise() -> None:
    terrain = ground(200, (1.0, 0.5, 0.1))
    names = range(200)
    near, far = (
        draw_frozen(terrain, replace(FREE, correlation_m=m), across(200), KEY, names)[0][:, 8, 8] for m in (1.0, 1.2)
    )  # fmt: skip
    assert float(torch.corrcoef(torch.stack((near, far)))[0, 1]) > 0.9


def wall_with_noise(batch: int) -> Terrain:
    """Firm ground crossed by a wall that lets through in about one draw of three."""
    terrain = ground(batch, (1.0, 0.8, 0.01))
    terrain.truth.means[:, :, :, 8] = 0.1 - 0.6
    terrain.truth.stds[:, :, :, 8] = 0.4
    return terrain


def test_ground_that_immobilises_the_robot_on_every_way_is_drawn_again() -> None:
    terrain, places = wall_with_noise(300), across(300)
    field, attempts = draw_frozen(terrain, IMMOBILISING, places, KEY, range(300))
    assert joined(field >= 0.1, terrain.grid, places).all()
    assert 2 < attempts.double().mean() < 6
    assert attempts.min() == 1
    first, once = draw_frozen(terrain, FREE, places, KEY, range(300))
    assert once.tolist() == [1] * 300
    # Those whose first draw had a way keep it; the others' first draw had none.
    kept = attempts == 1
    assert torch.equal(field[kept], first[kept])
    assert not joined(first[~kept] >= 0.1, terrain.grid, places.select(torch.nonzero(~kept)[:, 0])).any()


def test_what_immobilises_the_robot_counts_in_drawing_again() -> None:
    terrain, places = wall_with_noise(100), across(100)
    hard = replace(IMMOBILISING, immobile=Immobile(below=0.3))
    easier, harder = (
        draw_frozen(terrain, world, places, KEY, range(100))[1] for world in (IMMOBILISING, hard)
    )
    assert harder.double().mean() > easier.double().mean()


def test_ground_without_any_way_is_refused_with_the_map() -> None:
    terrain = ground(2, (1.0, 0.8, 0.01))
    terrain.truth.means[1, :, :, 8] = -1.0
    with pytest.raises(ConfigError, match=r"none for example 41\. Lower `immobile\.below`"):
        draw_frozen(terrain, IMMOBILISING, across(2), KEY, [40, 41])


def test_ground_is_joined_over_edges_and_not_corners() -> None:
    grid = Grid(4, 4, 1.0)
    staircase = torch.tensor([[1, 0, 0, 0], [1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1]]).bool()
    diagonal = torch.eye(4).bool()
    closed_goal, closed_start = staircase.clone(), staircase.clone()
    closed_goal[3, 3], closed_start[0, 0] = False, False
    maps = torch.stack((staircase, diagonal, closed_goal, closed_start, torch.ones(4, 4).bool()))
    places = factories.places(torch.tensor([[3.5, 3.5]] * 5), torch.tensor([[0.5, 0.5]] * 5))
    assert joined(maps, grid, places).tolist() == [True, False, False, False, True]


def test_start_is_x_and_y_and_not_row_and_column() -> None:
    grid = Grid(4, 6, 1.0)
    row = torch.zeros(1, 4, 6).bool()
    row[0, 1] = True
    places = factories.places(torch.tensor([[5.5, 1.5]]), torch.tensor([[0.5, 1.5]]))
    assert joined(row, grid, places).tolist() == [True]


def test_a_correlation_longer_than_a_quarter_of_the_map_is_refused_in_metres() -> None:
    draw_frozen(ground(1, *SOFT), replace(FREE, correlation_m=2.0), across(1), KEY, [0])
    with pytest.raises(ConfigError, match=r"`world.correlation_m` of at most 2 m, .* got 2.1 m"):
        draw_frozen(ground(1, *SOFT), replace(FREE, correlation_m=2.1), across(1), KEY, [0])
