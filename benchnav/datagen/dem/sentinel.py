"""Sentinels: undeclared values that mean missing in rasters.

Common ones are nines, the limits of an integer type, floats beyond any height, and 0.
"""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray

from benchnav.datagen.dem.raster import Raster

_SHORT = (-1, 255)  # these may be heights too
_LONG = (
    -999,
    -9999,
    9999,
    -99999,
    99999,
    -999999,
    999999,
    -32767,
    32767,
    -32768,
    65535,
    -1e6,
    1e6,
)
_CERTAIN = (-9999, -99999, -999999, -32767, -32768)  # for any quantity
_MAX_VALUE = 1e30  # larger values of any quantity are missing
_HUGE = 1e5  # larger values that are not heights are missing
_HEIGHTS_M = (-12_000.0, 30_000.0)  # of the Earth, the Moon and Mars
_APART_M = 100.0  # minimum difference from all heights of a map
_LONG_FROM = 999.0  # smaller values are common heights too
_LOWEST_LAND_M = -500.0
_TOLERANCE = 1e-6  # relative error of equal values


def looks_missing(raster: Raster, value: float) -> bool:
    """Return whether a value is one that commonly stands for missing.

    Args:
        raster: Raster that contains the value.
        value: Scaled value; a height is in metres.
    """
    return abs(raster.raw(value)) >= _HUGE or _is_common(raster, value)


def _is_common(raster: Raster, value: float) -> bool:
    sentinels = [*_SHORT, *_LONG]
    dtype = np.dtype(raster.file.dtypes[0])
    if dtype.kind in "iu":
        sentinels += [np.iinfo(dtype).min, np.iinfo(dtype).max]
    return _is_among(raster.raw(value), sentinels)


def _is_among(raw: float, sentinels: Sequence[float]) -> bool:
    return bool(np.isclose(raw, sentinels, rtol=_TOLERANCE, atol=0).any())


def is_certain_sentinel(raster: Raster, value: float, values: ndarray) -> bool:
    """Return whether an extreme value of a map means missing, for any quantity.

    If the raster declares another value for missing, the extreme means missing only if
    it is far from all other values: by more than half of its size.

    Args:
        raster: Raster that contains the value.
        value: Scaled value.
        values: Lowest or highest values in the map's cells, NaN in cells without one.
    """
    raw = raster.raw(value)
    if abs(raw) > _MAX_VALUE:
        return True
    if not _is_among(raw, _CERTAIN):
        return False
    distance = np.abs(values - value)
    is_other = distance > _TOLERANCE * abs(value)
    gap = np.min(distance, initial=np.inf, where=is_other)
    size = abs(raw * raster.file.scales[0] * raster.metres)
    return not raster.declares_missing or bool(gap > size / 2)


def is_missing(
    dem: Raster, height_m: float, heights_m: ndarray, cliff_m: float
) -> bool:
    """Return whether an extreme value of a map means missing instead of a height.

    Args:
        dem: Elevation model.
        height_m: The value.
        heights_m: Lowest or highest values in the map's cells, NaN in cells without
            one.
        cliff_m: Difference of heights that no natural terrain has next to a cell.
    """
    lowest_m, highest_m = _HEIGHTS_M
    is_height = lowest_m < height_m < highest_m
    is_suspect = _is_common if is_height else looks_missing
    if not np.isfinite(height_m) or not is_suspect(dem, height_m):
        return False
    distance_m = np.abs(heights_m - height_m)
    is_other = distance_m > _TOLERANCE * abs(height_m)
    if is_height and height_m > _LOWEST_LAND_M and not is_other.any():
        return False  # level terrain
    min_gap_m = widest_gap_m(cliff_m)
    if abs(dem.raw(height_m)) >= _LONG_FROM:
        min_gap_m = _APART_M
    gap_m = np.min(distance_m, initial=np.inf, where=is_other)
    return bool(gap_m > min_gap_m)


def widest_gap_m(cliff_m: float) -> float:
    """Return the widest gap between two heights of a map that may be a cliff."""
    return max(_APART_M, cliff_m)


def zero_gap_m(heights_m: ndarray) -> float:
    """Return the gap between a height of exactly 0 and all others.

    It is 0 if all heights are 0, or no height is.

    Args:
        heights_m: Lowest values in the map's cells, NaN in cells without one.
    """
    distance_m = np.abs(heights_m)
    is_other = distance_m > 0
    if not is_other.any() or not (distance_m == 0).any():
        return 0.0
    gap_m = np.min(distance_m, initial=np.inf, where=is_other)
    return float(gap_m)
