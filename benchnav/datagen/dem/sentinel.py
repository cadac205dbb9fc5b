"""Detection of sentinels: undeclared values that mark missing cells of a raster.

Common sentinels are numbers of nines such as −9999, the limits of an integer type,
numbers beyond any height, and 0.
"""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray

from benchnav.datagen.dem.raster import Raster

_AMBIGUOUS_SENTINELS = (-1, 255)  # these values may also be heights
_SENTINELS = (
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
# Sentinels of any quantity.
_CERTAIN_SENTINELS = (-9999, -99999, -999999, -32767, -32768)
_MAX_VALUE = 1e30  # a larger magnitude marks a missing value of any quantity
_HUGE = 1e5  # magnitude from which values that are not heights mark missing cells
_HEIGHTS_M = (-12_000.0, 30_000.0)  # limits of heights on the Earth, the Moon and Mars
_MIN_GAP_M = 100.0  # minimum difference between a sentinel and all heights of a map
# Minimum magnitude of a sentinel that is rarely a height.
_MIN_RARE = 999.0
_LOWEST_LAND_M = -500.0  # lowest height of land
_TOLERANCE = 1e-6  # maximum relative error of equal values


def looks_missing(raster: Raster, value: float) -> bool:
    """Return whether a value commonly marks missing cells.

    Args:
        raster: Raster that contains the value.
        value: Value in the unit of the quantity; a height is in metres.
    """
    return abs(raster.raw(value)) >= _HUGE or _is_common(raster, value)


def _is_common(raster: Raster, value: float) -> bool:
    sentinels = [*_AMBIGUOUS_SENTINELS, *_SENTINELS]
    dtype = np.dtype(raster.file.dtypes[0])
    if dtype.kind in "iu":
        sentinels += [np.iinfo(dtype).min, np.iinfo(dtype).max]
    return _is_among(raster.raw(value), sentinels)


def _is_among(raw: float, sentinels: Sequence[float]) -> bool:
    return bool(np.isclose(raw, sentinels, rtol=_TOLERANCE, atol=0).any())


def is_certain_sentinel(raster: Raster, value: float, values: ndarray) -> bool:
    """Return whether the extreme value of a map marks missing cells, for any quantity.

    If the raster declares another mark, the value must also differ from all other
    values by more than half of its magnitude.

    Args:
        raster: Raster that contains the value.
        value: Extreme value in the unit of the quantity.
        values: Lowest or highest value of each cell of the map, NaN if missing.
    """
    raw = raster.raw(value)
    if abs(raw) > _MAX_VALUE:
        return True
    if not _is_among(raw, _CERTAIN_SENTINELS):
        return False
    distance = np.abs(values - value)
    is_other = distance > _TOLERANCE * abs(value)
    gap = np.min(distance, initial=np.inf, where=is_other)
    size = abs(raw * raster.file.scales[0] * raster.metres)
    return not raster.declares_missing or bool(gap > size / 2)


def is_missing(
    dem: Raster, height_m: float, heights_m: ndarray, cliff_m: float
) -> bool:
    """Return whether the extreme elevation of a map marks missing cells.

    Args:
        dem: Elevation model.
        height_m: Extreme elevation in metres.
        heights_m: Lowest or highest elevation of each cell of the map in metres, NaN if
            missing.
        cliff_m: Difference in height between neighbouring cells that natural terrain
            does not exceed, in metres.
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
    if abs(dem.raw(height_m)) >= _MIN_RARE:
        min_gap_m = _MIN_GAP_M
    gap_m = np.min(distance_m, initial=np.inf, where=is_other)
    return bool(gap_m > min_gap_m)


def widest_gap_m(cliff_m: float) -> float:
    """Return the widest gap between two heights of a map that may be a cliff."""
    return max(_MIN_GAP_M, cliff_m)


def zero_gap_m(heights_m: ndarray) -> float:
    """Return the smallest magnitude of a height other than 0, in metres.

    It is 0 if all heights or no heights are exactly 0.

    Args:
        heights_m: Lowest height of each cell of a map in metres, NaN if missing.
    """
    distance_m = np.abs(heights_m)
    is_other = distance_m > 0
    if not is_other.any() or not (distance_m == 0).any():
        return 0.0
    gap_m = np.min(distance_m, initial=np.inf, where=is_other)
    return float(gap_m)
