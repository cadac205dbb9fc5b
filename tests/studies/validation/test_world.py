import numpy as np
import pytest
from scipy.stats import kstest, pearsonr

from studies.validation.ground import DIRT, VEGETATION
from studies.validation.world import draw_traction, draw_vegetation

MAPS = np.arange(300)


def test_border_is_dirt() -> None:
    vegetation = draw_vegetation(0, MAPS, 1.0)
    assert vegetation[:, 1:-1, 1:-1].all()
    assert vegetation.sum() == len(MAPS) * 49


@pytest.mark.parametrize("density", [0.1, 0.4, 0.7])
def test_density_is_that_of_the_inside(density: float) -> None:
    inside = draw_vegetation(0, MAPS, density)[:, 1:-1, 1:-1]
    assert inside.mean() == pytest.approx(density, abs=4 * np.sqrt(density * (1 - density) / inside.size))
    assert inside.mean(0).min() > density / 2  # in every cell
    assert inside.any(0).all()


def test_a_denser_map_has_the_vegetation_of_a_sparser_one() -> None:
    sparse, dense = (draw_vegetation(0, MAPS, density) for density in (0.4, 0.7))
    assert (dense | ~sparse).all()


def test_traction_has_the_distribution_of_its_ground() -> None:
    vegetation = draw_vegetation(0, MAPS, 0.4)
    traction = draw_traction(0, MAPS, 0, vegetation)
    for field in traction.swapaxes(0, 1):
        assert kstest(field[vegetation], VEGETATION.cdf).pvalue > 0.01
        assert kstest(field[~vegetation], DIRT.cdf).pvalue > 0.01


def test_linear_and_angular_traction_are_independent() -> None:
    vegetation = np.ones((len(MAPS), 9, 9), dtype=bool)
    linear, angular = draw_traction(0, MAPS, 0, vegetation).swapaxes(0, 1)
    assert abs(pearsonr(linear.ravel(), angular.ravel()).statistic) < 0.02
    assert abs(pearsonr(linear[:, :, 1:].ravel(), linear[:, :, :-1].ravel()).statistic) < 0.02


def test_realisations_maps_and_seeds_differ() -> None:
    vegetation = draw_vegetation(0, MAPS[:2], 1.0)
    first, again, other, seeded = (
        draw_traction(seed, MAPS[:2], realisation, vegetation)
        for seed, realisation in ((0, 0), (0, 0), (0, 1), (1, 0))
    )
    np.testing.assert_array_equal(first, again)
    assert (first[0] != first[1]).all()
    assert (first != other).all()
    assert (first != seeded).all()
    assert (draw_vegetation(0, MAPS, 0.4) != draw_vegetation(1, MAPS, 0.4)).any()


def test_a_map_is_the_same_in_any_batch() -> None:
    vegetation = draw_vegetation(0, MAPS, 0.4)
    np.testing.assert_array_equal(draw_vegetation(0, MAPS[7:9], 0.4), vegetation[7:9])
    np.testing.assert_array_equal(
        draw_traction(0, MAPS[7:9], 2, vegetation[7:9]), draw_traction(0, MAPS, 2, vegetation)[7:9]
    )
