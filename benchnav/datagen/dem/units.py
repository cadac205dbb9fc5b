"""Units of length that rasters declare, or leave out."""

import numpy as np

from benchnav.core.errors import DatasetError, expect
from benchnav.datagen.dem.crs import horizontal
from benchnav.datagen.dem.raster import Raster

UNITS_M = {"m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}  # by the names of PROJ
# How rasters write units, in lower case, by what `dem_unit` takes.
_SPELLINGS = {
    "m": ("m", "metre", "meter", "metres", "meters"),
    "ft": ("ft", "foot", "feet", "international foot", "international feet"),
    "us-ft": (
        "us-ft",
        "ftus",
        "us survey foot",
        "us survey feet",
        "us_survey_foot",
        "foot_us",
        "us foot",
    ),
    "0.1": ("dm", "decimetre", "decimeter", "decimetres", "decimeters"),
    "0.01": ("cm", "centimetre", "centimeter", "centimetres", "centimeters"),
    "0.001": ("mm", "millimetre", "millimeter", "millimetres", "millimeters"),
    "0.0254": ("in", "inch", "inches"),
    "0.9144": ("yd", "yard", "yards"),
    "1000": ("km", "kilometre", "kilometer", "kilometres", "kilometers"),
}


def in_unit(dem: Raster, unit: str) -> tuple[Raster, str]:
    """Return an elevation model with its unit, and the unit's source as text.

    Args:
        dem: Elevation model, one band.
        unit: A name of `UNITS_M`, or metres in a unit as text. If empty, the unit that
            the raster declares.

    Raises:
        ConfigError: If the unit is invalid.
        DatasetError: If it is empty and the raster may not be in metres.
    """
    declared = dem.file.units[0] or ""
    crs = horizontal(dem.file.crs)
    if unit:
        try:
            metres = UNITS_M.get(unit) or float(unit)
        except ValueError:
            metres = np.nan
        expect(
            0 < metres < np.inf,
            f"`dem_unit` among {', '.join(UNITS_M)}, or as metres in a unit, such as "
            f"0.01, got {unit!r}.",
        )
        instead = f", where the raster declares {declared!r}" if declared else ""
        return dem._replace(metres=metres), f"{unit} as set by `dem_unit`{instead}"
    name = _known(declared)
    if name == "m":
        return dem, "metres as the raster declares"
    if declared:
        option = (
            f"--dem-unit {name}"
            if name
            else "--dem-unit with the metres in one, such as 0.01"
        )
        raise DatasetError(
            f"Expected elevations of `dem` in metres, got {declared!r} in {dem.name}. "
            f"To convert them, pass {option}; "
            "if they are metres all the same, pass --dem-unit m."
        )
    if crs.is_projected and crs.linear_units_factor[1] != 1:
        raise DatasetError(
            f"Expected a unit of the elevations of `dem`, since {dem.name} is in "
            f"{crs.linear_units_factor[0]} and "
            "declares none, got none declared. Pass --dem-unit us-ft, --dem-unit ft "
            "or --dem-unit m, whichever it is."
        )
    return dem, "metres (the raster declares no unit: if others, set `dem_unit`)"


def check_metres(raster: Raster) -> None:
    """Check that a raster of metres does not declare another unit.

    Raises:
        DatasetError: If it does; the message has a command that converts it.
    """
    declared = raster.file.units[0] or ""
    name = _known(declared)
    if not declared or name == "m":
        return
    factor = f"{UNITS_M.get(name) or float(name):.10g}" if name else "METRES"
    unmasked = "" if raster.declares_missing else "--not-masked "
    convert = (
        f"rio calc {unmasked}-t float32 '(* {factor} (read 1))' {raster.name} "
        "metres.tif"
    )
    relabel = f"rio edit-info --bidx 1 --units m {raster.name}"
    raise DatasetError(
        f"Expected `{raster.argument}` in metres, got {declared!r} in {raster.name}. "
        "If they are metres all the same, "
        f"declare it: {relabel}. Else convert "
        f"them{'' if name else ', METRES being those in one'}: {convert}"
    )


def _known(declared: str) -> str:
    """Return the value of `dem_unit` for a declared unit; empty if it is unknown."""
    text = declared.strip().lower()
    return next((name for name, words in _SPELLINGS.items() if text in words), "")
