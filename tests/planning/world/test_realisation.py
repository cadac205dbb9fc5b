from dataclasses import replace

import pytest
import torch

from benchnav.core import rng
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning.world.realisation import Realisation
from benchnav.planning.world.world import World
from tests import factories

KEY = rng.stream_key(0, "noise")
PLACES = factories.places(torch.tensor([[6.0, 6.0]]))
MIDDLE = torch.tensor([[4.0, 4.0, 0.0]])


def realisation(mean: torch.Tensor, std: float = 0.1, noise: str = "resampled", steps: int = 200, **given):  # type: ignore[no-untyped-def]
    settings = {"key": KEY, "maps": range(len(mean)), **given}
    places = factories.places(torch.full((len(mean), 2), 6.0))
    return Realisation(factories.terrain(mean, std), World(noise=noise), places, steps, **settings)


def met(one: Realisation, batch: int, steps: int) -> torch.Tensor:
    """λ of robots that stand in the middle, shape [steps, B]."""
    state = MIDDLE.repeat(batch, 1)
    return torch.stack([one.at(state, torch.full((batch,), step)) for step in range(steps)])


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
    first, second = (met(realisation(even(3), key=rng.stream_key(seed, "noise")), 3, 4) for seed in (0, 1))
    assert not (first == second).any()


def test_another_time_budget_leaves_the_noise_as_it_is() -> None:
    short, long = (met(realisation(even(2), steps=steps), 2, 10) for steps in (10, 1000))
    assert torch.equal(short, long)


def test_noise_scales_with_each_cells_standard_deviation_and_mean() -> None:
    narrow, wide = (met(realisation(even(2, 0.5), std), 2, 20) - 0.5 for std in (0.01, 0.1))
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
    assert one.at(state, torch.zeros(2, dtype=torch.int64)).tolist() == [mean[0, 2, 14], mean[1, 11, 0]]
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
    with pytest.raises(ConfigError, match="not observed"):
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

    return TraversabilityMixture(pair(0.9, 0.1), pair(0.8, 0.05), pair(0.1, 0.05), (0, 0))


def test_resampled_noise_has_a_second_mode_where_the_truth_has_one() -> None:
    terrain = replace(factories.terrain(even(200)), truth=two_modes(200))
    places = factories.places(torch.full((200, 2), 6.0))
    one = Realisation(terrain, World(), places, 100, KEY, range(200))
    drawn = met(one, 200, 100).flatten().numpy()
    for value in (0.0, 0.03, 0.1, 0.5, 0.8, 0.95):
        expected = float(two_modes(1).cdf(value)[0, 0, 0])
        assert (drawn <= value).mean() == pytest.approx(expected, abs=0.01)
    off = one.at(torch.tensor([[-1.0, 4.0, 0.0]] * 200), torch.zeros(200, dtype=torch.int64))
    assert off.max() < 1e-8


def test_frozen_noise_stays_what_it_is_at_a_place() -> None:
    one = realisation(even(5), noise="frozen")
    drawn = met(one, 5, 20)
    assert (drawn == drawn[0]).all()
    assert len(drawn[0].unique()) == 5
    assert one.field is not None
    assert torch.equal(drawn[0], one.field[:, 8, 8])
    assert one.at(torch.tensor([[-0.1, 4.0, 0.0]] * 5), torch.zeros(5, dtype=torch.int64)).tolist() == [0] * 5


def test_only_resampled_noise_has_no_field() -> None:
    assert realisation(even(1)).field is None
    assert torch.equal(realisation(even(1), noise="stored").field, even(1))


@pytest.mark.parametrize("noise", ["resampled", "stored", "frozen"])
def test_ground_whose_class_is_not_known_is_not_driven_on(noise: str) -> None:
    terrain = factories.terrain(even(1))
    means = terrain.truth.means.clone()
    means[0, 0, 2, 2] = torch.nan
    terrain = replace(terrain, truth=replace(terrain.truth, means=means))
    with pytest.raises(ConfigError, match="a class in every cell"):
        Realisation(terrain, World(noise=noise), PLACES, 10, KEY, [0])


def test_what_changes_in_place_is_no_map() -> None:
    terrain = factories.terrain(even(1))
    one = Realisation(terrain, World(noise="stored"), PLACES, 10, KEY, [0])
    assert one.field is not None
    assert one.field.data_ptr() != terrain.traversability.data_ptr()
