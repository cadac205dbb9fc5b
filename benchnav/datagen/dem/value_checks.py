"""Checks of raster values: range, and undeclared sentinels.

The argument `maps` contains values by the name of the raster's argument, NaN if
missing. For averaged cells, it also contains the extremes before averaging, named
`ARGUMENT min` and `ARGUMENT max`. Letters in shapes: K bands, H×W cells.
"""

import numpy as np

from benchnav.core.errors import DatasetError
from benchnav.datagen.dem.raster import Raster
from benchnav.datagen.dem.sentinel import (
    is_certain_sentinel,
    is_missing,
    looks_missing,
    widest_gap_m,
    zero_gap_m,
)
from benchnav.datagen.schema import Field, Maps


def check_elevation(dem: Raster, values: Maps, cliff_m: float) -> None:
    """Check that the elevations of a map contain no undeclared sentinel.

    Args:
        dem: elevation model.
        values: values of the map by name, each of shape [K, H, W].
        cliff_m: difference in height between neighbouring cells that natural terrain
            does not exceed, in metres.

    Raises:
        DatasetError: If the elevations contain an undeclared sentinel.
    """
    lowest_m = values.get("dem min", values["dem"])
    highest_m = values.get("dem max", values["dem"])
    low, high = _range("dem", values)
    for extreme, heights_m in ((low, lowest_m), (high, highest_m)):
        if is_missing(dem, extreme, heights_m, cliff_m):
            expected = "elevations of `dem` without undeclared missing values"
            raise _invalid_value_error(dem, expected, low, high, extreme)
    declared_gap_m = widest_gap_m(cliff_m)
    max_gap_m = declared_gap_m if dem.declares_missing else cliff_m
    for value in (0, -1):
        gap_m = zero_gap_m(lowest_m - value)
        if gap_m > max_gap_m:
            expected = f"elevations of `dem` without a gap next to {value}"
            advice = ""
            if gap_m <= declared_gap_m:  # the value may be the height of the sea
                advice = (
                    f"If {value} is a height, declare a value that does not "
                    "occur, such as -9999."
                )
            raise _invalid_value_error(dem, expected, low, high, value, advice)


def check_limits(
    raster: Raster, maps: Maps, minimum: float, maximum: float
) -> tuple[float, float]:
    """Check a raster's values against limits; return their minimum and maximum.

    If all values are missing, the minimum is ∞ and the maximum −∞.

    Args:
        raster: raster of the values.
        maps: values of the maps by name.
        minimum: lower limit, inclusive.
        maximum: upper limit, inclusive.

    Raises:
        DatasetError: If a value is outside the limits.
    """
    low, high = _range(raster.argument, maps)
    if low < minimum or high > maximum:
        expected = f"values of `{raster.argument}` in [{minimum:g}, {maximum:g}]"
        invalid = low if low < minimum else high
        raise _invalid_value_error(raster, expected, low, high, invalid)
    return low, high


def check_layer(raster: Raster, maps: Maps, field: Field) -> bool:
    """Check the values of a layer; return whether it has any value on the maps.

    Args:
        raster: raster of the layer.
        maps: values of the maps by name.
        field: field of the layer, with its limits.

    Raises:
        DatasetError: If values are out of range, or contain an undeclared sentinel.
    """
    name = raster.argument
    low, high = check_limits(raster, maps, field.minimum, field.maximum)
    if low > high:
        return False
    for extreme, end in ((low, "min"), (high, "max")):
        extremes = maps.get(f"{name} {end}", maps[name])
        if is_certain_sentinel(raster, extreme, extremes):
            expected = f"values of `{name}` without undeclared missing values"
            advice = ""
            if not raster.declares_missing:
                advice = "If it is a valid value, declare a value that does not occur."
            raise _invalid_value_error(raster, expected, low, high, extreme, advice)
    return True


def _range(name: str, maps: Maps) -> tuple[float, float]:
    """Return minimum and maximum of a raster's values before averaging."""
    low = maps.get(f"{name} min", maps[name])
    high = maps.get(f"{name} max", maps[name])
    minimum = np.fmin.reduce(low, None, initial=np.inf)
    maximum = np.fmax.reduce(high, None, initial=-np.inf)
    return float(minimum), float(maximum)


def _invalid_value_error(
    raster: Raster,
    expected: str,
    low: float,
    high: float,
    invalid: float,
    advice: str = "",
) -> DatasetError:
    """Return an error on invalid values, with a command that corrects them.

    Args:
        raster: raster with the values.
        expected: text of the message after "Expected".
        low: lowest value of the maps.
        high: highest value of the maps.
        invalid: invalid value, which may be a sentinel.
        advice: further advice, one sentence; may be empty.
    """
    problem = f"Expected {expected}, got {low:g} to {high:g} in {raster.name}."
    value = raster.raw(invalid)
    if invalid and not looks_missing(raster, invalid):
        command = "."
        if raster.argument == "traversability":
            command = (
                "; from percent: rio calc --not-masked -t float32 "
                f"'(/ (read 1) 100.0)' {raster.name} scaled.tif"
            )
        return DatasetError(f"{problem} Convert the values{command}")
    nodata = raster.file.nodata
    if nodata is not None:
        replacement = f"(where (== (read 1) {value:.9g}) {nodata:.9g} (read 1))"
        remedy = (
            f"replace it by the declared value: rio calc '{replacement}' "
            f"{raster.name} filled.tif"
        )
    elif raster.declares_missing:  # a mask would hide the declared value
        remedy = (
            f"join it with the mask: rio calc --profile nodata={value:.9g} "
            f"'(read 1)' {raster.name} filled.tif"
        )
    else:
        remedy = f"declare it: rio edit-info --nodata {value:.9g} {raster.name}"
    if advice:
        remedy += f". {advice}"
    return DatasetError(f"{problem} If {value:.9g} marks missing cells, {remedy}")
