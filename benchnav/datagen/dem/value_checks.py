"""Checks of raster values: their range, and undeclared sentinels among them.

Maps contain values by the raster's argument, NaN if missing. For averaged cells, they
also contain the extremes by `ARGUMENT min` and `ARGUMENT max`. Letters in shapes: K
bands, H×W cells.
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
        values: values of the map, each of shape [K, H, W].
        cliff_m: difference of heights that no natural terrain has next to a cell.

    Raises:
        DatasetError: If they do.
    """
    lowest_m = values.get("dem min", values["dem"])
    highest_m = values.get("dem max", values["dem"])
    low, high = _range("dem", values)
    for extreme, heights_m in ((low, lowest_m), (high, highest_m)):
        if is_missing(dem, extreme, heights_m, cliff_m):
            expected = "elevations of `dem` without undeclared missing values"
            raise _out_of_range(dem, expected, low, high, extreme)
    declared_gap_m = widest_gap_m(cliff_m)
    max_gap_m = declared_gap_m if dem.declares_missing else cliff_m
    for value in (0, -1):
        gap_m = zero_gap_m(lowest_m - value)
        if gap_m > max_gap_m:
            expected = f"elevations of `dem` without a gap next to {value}"
            advice = ""
            if gap_m <= declared_gap_m:  # perhaps the sea
                advice = (
                    f"If {value} is a height, declare a value that does not "
                    "occur, such as -9999."
                )
            raise _out_of_range(dem, expected, low, high, value, advice)


def check_limits(
    raster: Raster, maps: Maps, minimum: float, maximum: float
) -> tuple[float, float]:
    """Return the minimum and maximum of a raster's values, after a check.

    Without any value, the minimum is larger.

    Args:
        raster: the raster.
        maps: values of some maps.
        minimum: lower limit.
        maximum: upper limit.

    Raises:
        DatasetError: If a value is beyond the limits.
    """
    low, high = _range(raster.argument, maps)
    if low < minimum or high > maximum:
        expected = f"values of `{raster.argument}` in [{minimum:g}, {maximum:g}]"
        invalid = low if low < minimum else high
        raise _out_of_range(raster, expected, low, high, invalid)
    return low, high


def check_layer(raster: Raster, maps: Maps, field: Field) -> bool:
    """Return whether a layer has a value on some maps, after a check.

    Args:
        raster: raster of the layer.
        maps: values of the maps.
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
                advice = "If it is a valid value, declare one that does not occur."
            raise _out_of_range(raster, expected, low, high, extreme, advice)
    return True


def _range(name: str, maps: Maps) -> tuple[float, float]:
    """Return minimum and maximum of a raster's values before averaging."""
    low = maps.get(f"{name} min", maps[name])
    high = maps.get(f"{name} max", maps[name])
    minimum = np.fmin.reduce(low, None, initial=np.inf)
    maximum = np.fmax.reduce(high, None, initial=-np.inf)
    return float(minimum), float(maximum)


def _out_of_range(
    raster: Raster,
    expected: str,
    low: float,
    high: float,
    invalid: float,
    advice: str = "",
) -> DatasetError:
    """Return an error on invalid values, with a command that corrects them.

    Args:
        raster: the raster.
        expected: expectation, for the message.
        low: lowest value of a map.
        high: highest value of a map.
        invalid: the invalid value, perhaps a sentinel.
        advice: further advice, a sentence.
    """
    problem = f"Expected {expected}, got {low:g} to {high:g} in {raster.name}."
    value = raster.raw(invalid)
    if invalid and not looks_missing(raster, invalid):
        percent = "."
        if raster.argument == "traversability":
            percent = (
                "; from percent: rio calc --not-masked -t float32 "
                f"'(/ (read 1) 100.0)' {raster.name} scaled.tif"
            )
        return DatasetError(f"{problem} Convert them{percent}")
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
