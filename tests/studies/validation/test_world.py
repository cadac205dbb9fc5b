import numpy as np
from scipy.stats import kstest

from studies.validation.ground import DIRT, VEGETATION
from studies.validation.world import draw_traction, draw_vegetation

MAPS = np.arange(300)


def test_traction_has_the_distribution_of_its_ground() -> None:
    vegetation = draw_vegetation(0, MAPS, 0.4)
    traction = draw_traction(0, MAPS, 0, vegetation)
    for field in traction.swapaxes(0, 1):
        assert kstest(field[vegetation], VEGETATION.cdf).pvalue > 0.01
        assert kstest(field[~vegetation], DIRT.cdf).pvalue > 0.01


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
