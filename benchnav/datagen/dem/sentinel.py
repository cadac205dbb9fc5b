"""Sentinels: undeclared values that mean missing in rasters.

Common ones are nines, the limits of an integer type, floats beyond any height, and 0.
"""

import numpy as np
from numpy import ndarray

from benchnav.datagen.dem.raster import Raster

_SHORT = (-1, 255)  # may be heights too
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
_HUGE = 1e5  # larger values that are not heights are missing
_HEIGHTS_M = (-12_000.0, 30_000.0)  # of the Earth, the Moon and Mars
_APART_M = 100.0  # from all heights of a map
_FROM = 999.0  # smaller values are common heights too


def looks_missing(raster: Raster, value: float) -> bool:
    """Return whether a value is one that commonly stands for missing.

    Args:
        raster: Whose value it is.
        value: Scaled, in metres where it is a height.
    """
    return abs(raster.raw(value)) >= _HUGE or _is_common(raster, value)


def _is_common(raster: Raster, value: float) -> bool:
    raw, dtype = raster.raw(value), np.dtype(raster.file.dtypes[0])
    ends = (np.iinfo(dtype).min, np.iinfo(dtype).max) if dtype.kind in "iu" else ()
    sentinels = (*_SHORT, *_LONG, *ends)
    return any(np.isclose(raw, value, rtol=1e-6, atol=0) for value in sentinels)


def is_certain(raster: Raster, value: float, values: ndarray) -> bool:
    """Return whether an extreme value of a map means missing, for any quantity.

    Args:
        raster: Whose value it is.
        value: Scaled.
        values: Lowest or highest values in the map's cells, NaN in cells without one.
            Where the raster declares another value for missing, all others are nearer
            to 0 by more than half of it.
    """
    raw = raster.raw(value)
    if abs(raw) > 1e30:
        return True
    if not any(np.isclose(raw, sentinel, rtol=1e-6, atol=0) for sentinel in _CERTAIN):
        return False
    apart = np.abs(values - value)
    others = apart > 1e-6 * abs(value)
    reach = abs(raw * raster.file.scales[0] * raster.metres) / 2
    return not raster.declares_missing or bool(
        np.min(apart, initial=np.inf, where=others) > reach
    )


def is_missing(
    dem: Raster, height_m: float, heights_m: ndarray, cliff_m: float
) -> bool:
    """Return whether an extreme value of a map means missing instead of a height.

    Args:
        dem: Elevation model.
        height_m: The value.
        heights_m: Lowest or highest values in the map's cells, NaN in cells without
            one.
        cliff_m: Difference of heights that no natural ground has next to a cell.
    """
    is_height = _HEIGHTS_M[0] < height_m < _HEIGHTS_M[1]
    is_suspect = _is_common if is_height else looks_missing
    if not np.isfinite(height_m) or not is_suspect(dem, height_m):
        return False
    apart_m = np.abs(heights_m - height_m)
    others = apart_m > 1e-6 * abs(height_m)
    if is_height and height_m > -500 and not others.any():
        return False  # level ground
    gap_m = _APART_M if abs(dem.raw(height_m)) >= _FROM else widest_gap_m(cliff_m)
    return bool(np.min(apart_m, initial=np.inf, where=others) > gap_m)


def widest_gap_m(cliff_m: float) -> float:
    """Return the widest gap between two heights of a map that may be a cliff."""
    return max(_APART_M, cliff_m)


def zero_gap_m(heights_m: ndarray) -> float:
    """Return the gap between a height of exactly 0 and all others; 0 without both.

    Args:
        heights_m: Lowest values in the map's cells, NaN in cells without one.
    """
    apart_m = np.abs(heights_m)
    others = apart_m > 0
    if not others.any() or not (apart_m == 0).any():
        return 0.0
    return float(np.min(apart_m, initial=np.inf, where=others))
