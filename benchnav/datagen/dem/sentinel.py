"""Values that stand for missing in rasters that do not declare it.

Rasters commonly write nines, the ends of an integer type, or floats beyond any height.
"""

import numpy as np
from numpy import ndarray

from benchnav.datagen.dem.raster import Raster

_SHORT = (-1, 255)  # which are heights too
_LONG = (-999, -9999, 9999, -99999, 99999, -999999, 999999, -32767, 32767, -32768, 65535, -1e6, 1e6)
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
    raw, dtype = raster.raw(value), np.dtype(raster.file.dtypes[0])
    ends = (np.iinfo(dtype).min, np.iinfo(dtype).max) if dtype.kind in "iu" else ()
    return abs(raw) >= _HUGE or any(
        np.isclose(raw, other, rtol=1e-6, atol=0) for other in (*_SHORT, *_LONG, *ends)
    )


def is_certain(raster: Raster, value: float) -> bool:
    """Return whether a value stands for missing in a raster of any quantity; see `looks_missing`."""
    raw = raster.raw(value)
    return raw < -1e30 or any(np.isclose(raw, other, rtol=1e-6, atol=0) for other in _CERTAIN)


def is_missing(dem: Raster, height_m: float, heights_m: ndarray, cliff_m: float) -> bool:
    """Return whether the lowest or highest value of a map stands for missing rather than for a height.

    Args:
        dem: Elevation model.
        height_m: The value.
        heights_m: Lowest or highest values in the map's cells, NaN where there are none.
        cliff_m: Difference of heights that no natural ground has next to a cell.
    """
    if not np.isfinite(height_m) or not looks_missing(dem, height_m):
        return False
    is_height = _HEIGHTS_M[0] < height_m < _HEIGHTS_M[1]
    if is_height and dem.mask_kinds != {"all_valid"}:
        return False  # the raster declares another value
    apart_m = np.abs(heights_m - height_m)
    others = apart_m > 1e-6 * abs(height_m)
    if is_height and height_m > -500 and not others.any():
        return False  # level ground
    least_m = _APART_M if abs(dem.raw(height_m)) >= _FROM else max(_APART_M, cliff_m)
    return bool(np.min(apart_m, initial=np.inf, where=others) > least_m)
