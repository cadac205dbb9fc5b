from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from benchnav.core import rng
from benchnav.core.copula import correlated_normal
from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.planning.free_space import Immobile
from benchnav.planning.world.realisation import Realisation, are_connected, draw_frozen
from benchnav.planning.world.world import Endpoints, World
from tests import factories

KEY = rng.stream_key(0, "noise")
PLACES = factories.places(torch.tensor([[6.0, 6.0]]))
MIDDLE = torch.tensor([[4.0, 4.0, 0.0]])


def realisation(
    mean: torch.Tensor,
    std: float = 0.1,
    noise: str = "resampled",
    steps: int = 200,
    **given,
):  # type: ignore[no-untyped-def]
    settings = {"key": KEY, "maps": range(len(mean)), **given}
    places = factories.places(torch.full((len(mean), 2), 6.0))
    return Realisation(
        factories.terrain(mean, std), World(noise=noise), places, steps, **settings
    )


def met(one: Realisation, batch: int, steps: int) -> torch.Tensor:
    """λ of robots that stand in the middle, shape [steps, B]."""
    state = MIDDLE.repeat(batch, 1)
    return torch.stack(
        [one.at(state, torch.full((batch,), step)) for step in range(steps)]
    )


def even(batch: int, value: float = 0.5) -> torch.Tensor:
    return torch.full((batch, 16, 16), value)


def test_resampled_noise_has_the_latent_distribution_at_each_step() -> None:
    drawn = met(realisation(even(40)), 40, 200)
    assert drawn.mean().item() == pytest.approx(0.5, abs=0.005)
    assert drawn.std().item() == pytest.approx(0.1, abs=0.005)
    # Neither steps nor episodes are alike.
    assert len(drawn.unique()) > 7900


def test_noise_is_keyed_by_map_and_step_whatever_the_batch() -> None:
    together = met(realisation(even(40)), 40, 5)
    alone = met(realisation(even(1), maps=[7]), 1, 5)
    assert torch.equal(alone[:, 0], together[:, 7])
    turned = met(realisation(even(2), maps=[9, 7]), 2, 5)
    assert torch.equal(turned, together[:, [9, 7]])


def test_another_root_is_another_noise() -> None:
    first, second = (
        met(realisation(even(3), key=rng.stream_key(seed, "noise")), 3, 4)
        for seed in (0, 1)
    )
    assert not (first == second).any()


def test_another_time_budget_leaves_the_noise_as_it_is() -> None:
    short, long = (
        met(realisation(even(2), steps=steps), 2, 10) for steps in (10, 1000)
    )
    assert torch.equal(short, long)


def test_noise_scales_with_each_cells_standard_deviation_and_mean() -> None:
    narrow, wide = (
        met(realisation(even(2, 0.5), std), 2, 20) - 0.5 for std in (0.01, 0.1)
    )
    torch.testing.assert_close(10 * narrow, wide, atol=1e-5, rtol=0)
    lower = met(realisation(even(2, 0.4), 0.01), 2, 20)
    torch.testing.assert_close(lower - 0.4, narrow, atol=1e-6, rtol=0)


def test_traversability_is_clipped_to_its_range() -> None:
    drawn = met(realisation(torch.cat((even(20, 1.0), even(20, 0.0)))), 40, 20)
    assert drawn.min() == 0
    assert drawn.max() == 1
    assert ((drawn > 0) & (drawn < 1)).any()


def test_lambda_is_read_in_the_cell_where_the_robot_stands() -> None:
    mean = torch.rand(2, 12, 20)
    one = realisation(mean, 0.0)
    state = torch.tensor([[7.3, 1.2, 0.0], [0.1, 5.9, 0.0]])
    assert one.at(state, torch.zeros(2, dtype=torch.int64)).tolist() == [
        mean[0, 2, 14],
        mean[1, 11, 0],
    ]
    off = torch.tensor([[-0.1, 1.2, 0.0], [3.0, 6.1, 0.0]])
    assert one.at(off, torch.zeros(2, dtype=torch.int64)).tolist() == [0, 0]


def test_stored_noise_is_the_maps_realised_traversability() -> None:
    terrain = factories.terrain(torch.full((1, 16, 16), 0.5))
    terrain = replace(terrain, traversability=torch.rand(1, 16, 16))
    one = Realisation(terrain, World(noise="stored"), PLACES, 10, KEY, [0])
    for step in range(3):
        at = one.at(torch.tensor([[3.3, 1.2, 0.0]]), torch.tensor([step]))
        assert at[0] == terrain.traversability[0, 2, 6]


def test_stored_noise_needs_every_cell_observed() -> None:
    terrain = factories.terrain(even(1))
    holed = terrain.traversability.clone()
    holed[0, 3, 3] = torch.nan
    terrain = replace(terrain, traversability=holed)
    Realisation(terrain, World(noise="resampled"), PLACES, 10, KEY, [0])
    with pytest.raises(ConfigError, match="cells without λ"):
        Realisation(terrain, World(noise="stored"), PLACES, 10, KEY, [0])


@pytest.mark.parametrize("noise", ["resampled", "stored", "frozen"])
def test_some_episodes_are_exchanged_and_the_others_stay(noise: str) -> None:
    ground = torch.rand(3, 16, 16)
    one = realisation(ground, noise=noise)
    other = realisation(torch.rand(2, 16, 16), noise=noise, maps=[20, 21])
    before, given = met(one, 3, 5), ground.clone()
    field = None if one.field is None else one.field.clone()
    one.exchange_(torch.tensor([2, 0]), other)
    mixed = met(one, 3, 5)
    if field is not None:
        assert torch.equal(one.field[[2, 0]], other.field)
        assert torch.equal(one.field[1], field[1])
    assert torch.equal(mixed[:, 1], before[:, 1])
    assert torch.equal(mixed[:, [2, 0]], met(other, 2, 5))
    assert torch.equal(ground, given)  # the maps are left as they were


def two_modes(batch: int, size: int = 16) -> TraversabilityMixture:
    """λ of N(0.8, 0.1) on 90 % of the ground and N(0.05, 0.05) on the rest, clipped."""
    shape = (batch, 2, size, size)

    def pair(first: float, second: float) -> torch.Tensor:
        return torch.tensor([first, second]).view(1, 2, 1, 1).expand(shape).clone()

    return TraversabilityMixture(
        pair(0.9, 0.1), pair(0.8, 0.05), pair(0.1, 0.05), (0, 0)
    )


def test_resampled_noise_has_a_second_mode_where_the_truth_has_one() -> None:
    terrain = replace(factories.terrain(even(200)), truth=two_modes(200))
    places = factories.places(torch.full((200, 2), 6.0))
    one = Realisation(terrain, World(), places, 100, KEY, range(200))
    drawn = met(one, 200, 100).flatten().numpy()
    for value in (0.0, 0.03, 0.1, 0.5, 0.8, 0.95):
        expected = float(two_modes(1).cdf(value)[0, 0, 0])
        assert (drawn <= value).mean() == pytest.approx(expected, abs=0.01)
    off = one.at(
        torch.tensor([[-1.0, 4.0, 0.0]] * 200), torch.zeros(200, dtype=torch.int64)
    )
    assert off.max() < 1e-8


def test_frozen_noise_stays_what_it_is_at_a_place() -> None:
    one = realisation(even(5), noise="frozen")
    drawn = met(one, 5, 20)
    assert (drawn == drawn[0]).all()
    assert len(drawn[0].unique()) == 5
    assert one.field is not None
    assert torch.equal(drawn[0], one.field[:, 8, 8])
    assert (
        one.at(
            torch.tensor([[-0.1, 4.0, 0.0]] * 5), torch.zeros(5, dtype=torch.int64)
        ).tolist()
        == [0] * 5
    )


def test_only_resampled_noise_has_no_field() -> None:
    assert realisation(even(1)).field is None
    assert torch.equal(realisation(even(1), noise="stored").field, even(1))


@pytest.mark.parametrize("noise", ["resampled", "stored", "frozen"])
def test_ground_whose_class_is_not_known_is_not_driven_on(noise: str) -> None:
    terrain = factories.terrain(even(1))
    means = terrain.truth.means.clone()
    means[0, 0, 2, 2] = torch.nan
    terrain = replace(terrain, truth=replace(terrain.truth, means=means))
    with pytest.raises(ConfigError, match="a class in each cell"):
        Realisation(terrain, World(noise=noise), PLACES, 10, KEY, [0])


def test_what_changes_in_place_is_no_map() -> None:
    terrain = factories.terrain(even(1))
    one = Realisation(terrain, World(noise="stored"), PLACES, 10, KEY, [0])
    assert one.field is not None
    assert one.field.data_ptr() != terrain.traversability.data_ptr()


FREE = World(noise="frozen")
IMMOBILISING = World(noise="frozen", immobile=Immobile(below=0.1))


def ground(
    batch: int, *components: tuple[float, float, float], size: int = 16
) -> Terrain:
    """Flat ground with the same mixture of (weight, mean, std) in each cell."""
    columns = torch.tensor(components).T[:, None, :, None, None]
    weights, means, stds = (c.expand(batch, -1, size, size).clone() for c in columns)
    made = factories.terrain(torch.full((batch, size, size), 0.5))
    return replace(
        made, truth=TraversabilityMixture(weights, means, stds, (0,) * len(components))
    )


def across(batch: int, size: int = 16) -> Endpoints:
    """From one corner to the other."""
    start, goal = (
        torch.full((batch, 2), 1.25),
        torch.full((batch, 2), 0.5 * size - 1.25),
    )
    return factories.places(goal, start)


SOFT = ((0.9, 0.8, 0.1), (0.1, 0.05, 0.05))


def test_marginals_are_each_cells_own_distribution() -> None:
    """Before any field is rejected, pooled over realisations, in two cells of different
    ground.
    """
    terrain = ground(1, *SOFT)
    terrain.truth.means[:, 0, 8:] = 0.5
    draws = [draw_frozen(terrain, FREE, across(1), KEY, [i])[0][0] for i in range(2000)]
    field = torch.stack(draws).double().numpy()
    for row in (3, 12):
        truth = terrain.truth
        cell = (
            t[:, :, row : row + 1, :1].double()
            for t in (truth.weights, truth.means, truth.stds)
        )
        mixture = TraversabilityMixture(*cell)
        drawn = field[:, row, 5]
        assert (drawn == 0).mean() == pytest.approx(float(mixture.cdf(0.0)), abs=0.01)
        inside = drawn[(drawn > 0) & (drawn < 1)]
        low, high = float(mixture.cdf(0.0)), 1 - float(mixture.chance(1.0))

        def share(
            value: np.ndarray, mixture: TraversabilityMixture = mixture
        ) -> np.ndarray:
            return np.array(
                [float(mixture.cdf(float(v))) for v in np.atleast_1d(value)]
            )

        found = stats.kstest(
            inside, lambda v, low=low, high=high: (share(v) - low) / (high - low)
        )
        assert found.pvalue > 1e-3


def test_the_kernel_of_the_gaussian_field_is_that_of_the_world() -> None:
    terrain = ground(1, (1.0, 0.5, 0.05))
    for kernel in ("gaussian", "matern32"):
        world = replace(FREE, correlation_m=1.5, kernel=kernel)
        drawn = draw_frozen(terrain, world, across(1), KEY, [3])[0][0]
        key = rng.stream_key(KEY, 3, "field", 0)
        normal = correlated_normal(key, np.arange(1), terrain.grid.shape, 3.0, kernel)[
            0
        ]
        np.testing.assert_allclose((drawn.double() - 0.5) / 0.05, normal, atol=1e-5)


@pytest.mark.parametrize("correlation_m", [0.5, 1.5])
def test_the_correlation_of_the_gaussian_field_is_that_of_the_world(
    correlation_m: float,
) -> None:
    terrain, world = (
        ground(1, (1.0, 0.5, 0.05)),
        replace(FREE, correlation_m=correlation_m),
    )
    draws = [
        draw_frozen(terrain, world, across(1), KEY, [i])[0][0] for i in range(1500)
    ]
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
    alone, _ = draw_frozen(
        terrain.select(torch.tensor([2])), IMMOBILISING, across(1), KEY, [7]
    )
    assert torch.equal(alone[0], together[2])
    assert len({float(values.sum()) for values in together}) == 4
    other, _ = draw_frozen(
        terrain, IMMOBILISING, across(4), rng.stream_key(1, "noise"), [3, 5, 7, 9]
    )
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
    assert are_connected(field >= 0.1, terrain.grid, places).all()
    assert 2 < attempts.double().mean() < 6
    assert attempts.min() == 1
    first, once = draw_frozen(terrain, FREE, places, KEY, range(300))
    assert once.tolist() == [1] * 300
    # Those whose first draw had a way keep it; the others' first draw had none.
    kept = attempts == 1
    assert torch.equal(field[kept], first[kept])
    assert not are_connected(
        first[~kept] >= 0.1, terrain.grid, places.select(torch.nonzero(~kept)[:, 0])
    ).any()


def test_what_immobilises_the_robot_counts_in_drawing_again() -> None:
    terrain, places = wall_with_noise(100), across(100)
    hard = replace(IMMOBILISING, immobile=Immobile(below=0.3))
    easier, harder = (
        draw_frozen(terrain, world, places, KEY, range(100))[1]
        for world in (IMMOBILISING, hard)
    )
    assert harder.double().mean() > easier.double().mean()


def test_ground_without_any_way_is_refused_with_the_map() -> None:
    terrain = ground(2, (1.0, 0.8, 0.01))
    terrain.truth.means[1, :, :, 8] = -1.0
    with pytest.raises(ConfigError, match=r"none for map 41\. Lower `immobile\.below`"):
        draw_frozen(terrain, IMMOBILISING, across(2), KEY, [40, 41])


def test_ground_is_joined_over_edges_and_not_corners() -> None:
    grid = Grid(4, 4, 1.0)
    staircase = torch.tensor(
        [[1, 0, 0, 0], [1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1]]
    ).bool()
    diagonal = torch.eye(4).bool()
    closed_goal, closed_start = staircase.clone(), staircase.clone()
    closed_goal[3, 3], closed_start[0, 0] = False, False
    maps = torch.stack(
        (staircase, diagonal, closed_goal, closed_start, torch.ones(4, 4).bool())
    )
    places = factories.places(
        torch.tensor([[3.5, 3.5]] * 5), torch.tensor([[0.5, 0.5]] * 5)
    )
    assert are_connected(maps, grid, places).tolist() == [
        True,
        False,
        False,
        False,
        True,
    ]


def test_start_is_x_and_y_and_not_row_and_column() -> None:
    grid = Grid(4, 6, 1.0)
    row = torch.zeros(1, 4, 6).bool()
    row[0, 1] = True
    places = factories.places(torch.tensor([[5.5, 1.5]]), torch.tensor([[0.5, 1.5]]))
    assert are_connected(row, grid, places).tolist() == [True]


def test_a_correlation_longer_than_a_quarter_of_the_map_is_refused_in_metres() -> None:
    draw_frozen(ground(1, *SOFT), replace(FREE, correlation_m=2.0), across(1), KEY, [0])
    with pytest.raises(
        ConfigError, match=r"`world.correlation_m` of at most 2 m .* got 2.1 m"
    ):
        draw_frozen(
            ground(1, *SOFT), replace(FREE, correlation_m=2.1), across(1), KEY, [0]
        )
