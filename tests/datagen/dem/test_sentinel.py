"""Values that stand for missing are distinguished from heights, whatever the raster
declares.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchnav.datagen.dem.raster import Raster
from benchnav.datagen.dem.sentinel import (
    is_certain_sentinel,
    is_missing,
    widest_gap_m,
    zero_gap_m,
)

VALUES = (-9999, -999, -32768, -32767, 9999, 65535, -1e6, 1e6, -3.4e38, 3.4e38)
NATURAL = (-9999, -999, 9999, -1, 255, 999, 0)


def raster(declares: bool, scale: float = 1.0, metres: float = 1.0) -> Raster:
    kind = SimpleNamespace(name="nodata" if declares else "all_valid")
    file = SimpleNamespace(
        dtypes=["float64"],
        scales=(scale,),
        offsets=(0.0,),
        mask_flag_enums=[[kind]],
        nodata=None,
    )
    return Raster("dem", "dem.tif", file, metres)


@st.composite
def terrains(draw: Any) -> np.ndarray:
    """Heights whose largest step between neighbours is 20 m, and cliffs of up to 100 m."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    steps = rng.uniform(-1, 1, (2, 16)) * draw(st.sampled_from([0.1, 3, 20]))
    heights_m = steps[0].cumsum()[:, None] + steps[1].cumsum()
    heights_m[:, rng.integers(1, 16) :] += rng.uniform(
        0, draw(st.sampled_from([0, 100]))
    )
    return heights_m + draw(st.floats(-500, 8000))


@given(
    terrains(),
    st.sampled_from(NATURAL),
    st.booleans(),
    st.booleans(),
    st.sampled_from([0, 50]),
)
def test_no_height_of_natural_ground_stands_for_missing(
    heights_m: np.ndarray, value: float, is_low: bool, declares: bool, cliff_m: float
) -> None:
    """Also where the lowest or highest is at a common value, level, and below or above
    a cliff.
    """
    ends = [heights_m.min(), heights_m.max()]
    heights_m = heights_m - ends[not is_low] + value
    heights_m += np.where(heights_m == value, 0, cliff_m if is_low else -cliff_m)
    if value < -500:  # below which level ground at a common value is taken for missing
        heights_m[0, 0] += 0.5
    for height_m in (heights_m.min(), heights_m.max()):
        assert not is_missing(raster(declares), height_m, heights_m, 5.67)
    assert zero_gap_m(heights_m) <= widest_gap_m(5.67)


@given(terrains(), st.sampled_from(VALUES), st.booleans(), st.sampled_from([1.0, 0.1]))
def test_a_value_far_from_all_heights_stands_for_missing(
    heights_m: np.ndarray, value: float, declares: bool, scale: float
) -> None:
    value *= scale
    if np.abs(heights_m - value).min() <= 110:
        heights_m = heights_m - heights_m.min() + value + 120
    heights_m[3, 4], heights_m[5, 6] = value, np.nan
    odd = (
        np.nanmin(heights_m) if value == np.nanmin(heights_m) else np.nanmax(heights_m)
    )
    if odd == value:
        assert is_missing(raster(declares, scale), value, heights_m, 5.67)


@given(terrains())
def test_zeros_far_from_all_heights_are_a_gap(heights_m: np.ndarray) -> None:
    heights_m += 500 - heights_m.min()
    assert zero_gap_m(heights_m) == 0
    heights_m[:3] = 0
    assert zero_gap_m(heights_m) == heights_m[3:].min() > 499


@pytest.mark.parametrize("scale", [1.0, 1e-4])
def test_layers_of_many_values_down_to_a_common_one_are_kept_where_another_is_declared(
    scale: float,
) -> None:
    values = np.linspace(-9999, 9000, 50) * scale
    assert not is_certain_sentinel(raster(True, scale), values[0], values)
    assert is_certain_sentinel(raster(False, scale), values[0], values)
    assert is_certain_sentinel(
        raster(True, scale), values[0], np.array([values[0], 0, np.nan])
    )
