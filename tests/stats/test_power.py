import math

import numpy as np
import pytest

from benchnav.stats.flips import sign_flip_p
from benchnav.stats.power import maps_needed, smallest_difference


@pytest.mark.parametrize("alpha", [0.05, 0.05 / 15])
def test_the_smallest_difference_is_shown_in_four_of_five_studies(alpha: float) -> None:
    # A quarter of 200 maps end differently; the test used is the one of the tables.
    difference = smallest_difference(0.5, 200, alpha)
    generator = np.random.default_rng(0)
    chances = [(0.25 + difference) / 2, 0.75, (0.25 - difference) / 2]
    studies = generator.choice([1, 0, -1], size=(1500, 200), p=chances)
    shown = np.mean([sign_flip_p(gain) < alpha for gain in studies])
    # McNemar's test is discrete, and shows a little less than its level allows.
    assert 0.72 < shown < 0.83


def test_maps_needed_are_those_that_show_the_difference() -> None:
    for difference in (0.02, 0.05, 0.2):
        maps = maps_needed(0.5, difference, 0.01)
        assert (
            smallest_difference(0.5, maps, 0.01)
            <= difference
            < smallest_difference(0.5, maps - 1, 0.01)
        )


def test_more_maps_are_needed_for_more_power_and_less_chance() -> None:
    usual = maps_needed(0.4, 0.1, 0.05)
    assert usual == 126  # (1.95996 + 0.84162)² · 16
    assert maps_needed(0.4, 0.1, 0.005) > usual


def test_where_no_result_would_be_significant_nothing_is_detected() -> None:
    """Of M maps the least p of a sign-flip test is 2 of 2^M."""
    assert smallest_difference(0.1, 5, 0.05) == math.inf
    assert smallest_difference(0.1, 6, 0.05) < 1
    assert smallest_difference(0.1, 6, 0.05 / 3) == math.inf
