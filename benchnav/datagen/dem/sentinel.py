"""Values that stand for missing in rasters that do not declare them, or declare another
one.

Rasters commonly write nines, the ends of an integer type, floats beyond any height, or
0.
"""

import numpy as np
from numpy import ndarray

from benchnav.datagen.dem.raster import Raster

_SHORT = (-1, 255)  # which are heights too
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
_CERTAIN = (-9999, -99999, -999999, -32767, -32768)  # of any quantity
_HUGE = 1e5  # from which on a value is missing where it is no height
_HEIGHTS_M = (-12_000.0, 30_000.0)  # of the Earth, the Moon and Mars
_APART_M = 100.0  # from all heights of a map
_FROM = 999.0  # below it values are common as heights too


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
    return any(
        np.isclose(raw, other, rtol=1e-6, atol=0) for other in (*_SHORT, *_LONG, *ends)
    )


def is_certain(raster: Raster, value: float, values: ndarray) -> bool:
    """Return whether the lowest or highest value of a map stands for missing in a
    raster of any quantity.

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
    if not any(np.isclose(raw, other, rtol=1e-6, atol=0) for other in _CERTAIN):
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
    """Return whether the lowest or highest value of a map stands for missing rather
    than for a height.

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
    """Return how far cells of a height of exactly 0 are from all others; 0 if either
    kind is missing.

    Args:
        heights_m: Lowest values in the map's cells, NaN in cells without one.
    """
    apart_m = np.abs(heights_m)
    others = apart_m > 0
    if not others.any() or not (apart_m == 0).any():
        return 0.0
    return float(np.min(apart_m, initial=np.inf, where=others))
