"""Units of length in rasters, declared or set by the user."""

import numpy as np

from benchnav.core.errors import DatasetError, expect
from benchnav.datagen.dem.crs import horizontal
from benchnav.datagen.dem.raster import Raster

UNITS_M = {"m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}  # length by PROJ's unit name
# Spellings of units that rasters declare, in lower case, by the value of `dem_unit`.
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
        unit: Name in `UNITS_M`, or the length of the unit in metres, as text. If empty,
            the unit that the raster declares.

    Raises:
        ConfigError: If the unit is invalid.
        DatasetError: If `unit` is empty and elevations may not be in metres.
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
            f"`dem_unit` to be one of {', '.join(UNITS_M)}, or the length of the unit "
            f"in metres, such as 0.01 for centimetres, got {unit!r}.",
        )
        source = f"{unit} as set by `dem_unit`"
        if declared:
            source += f", although the raster declares {declared!r}"
        return dem._replace(metres=metres), source
    name = _dem_unit_of(declared)
    if name == "m":
        return dem, "metres as the raster declares"
    if declared:
        option = "--dem-unit with the length of the unit in metres, such as 0.01"
        if name:
            option = f"--dem-unit {name}"
        raise DatasetError(
            f"Expected elevations of `dem` in metres, got {declared!r} in {dem.name}. "
            f"To convert the elevations, pass {option}. If they are in metres "
            "nevertheless, pass --dem-unit m."
        )
    if crs.is_projected and crs.linear_units_factor[1] != 1:
        raise DatasetError(
            "Expected `dem` to declare the unit of its elevations, got no unit. The "
            f"CRS of {dem.name} is in {crs.linear_units_factor[0]}, so the unit of "
            "elevations may not be the metre. Pass the unit: --dem-unit us-ft, "
            "--dem-unit ft or --dem-unit m."
        )
    return dem, "metres (the raster declares no unit; `dem_unit` sets another)"


def check_metres(raster: Raster) -> None:
    """Check that a raster of a layer in metres does not declare another unit.

    Raises:
        DatasetError: If the raster declares another unit. The message contains a
            command that converts it.
    """
    declared = raster.file.units[0] or ""
    name = _dem_unit_of(declared)
    if not declared or name == "m":
        return
    factor = "METRES"
    explanation = ", where METRES is the length of the unit in metres"
    if name:
        factor = f"{UNITS_M.get(name) or float(name):.10g}"
        explanation = ""
    unmasked = "" if raster.declares_missing else "--not-masked "
    convert = (
        f"rio calc {unmasked}-t float32 '(* {factor} (read 1))' {raster.name} "
        "metres.tif"
    )
    relabel = f"rio edit-info --bidx 1 --units m {raster.name}"
    raise DatasetError(
        f"Expected `{raster.argument}` in metres, got {declared!r} in {raster.name}. "
        f"If the values are in metres nevertheless, declare this: {relabel}. "
        f"Otherwise, convert them{explanation}: {convert}"
    )


def _dem_unit_of(declared: str) -> str:
    """Return the value of `dem_unit` for a declared unit; empty if it is unknown."""
    text = declared.strip().lower()
    for name, spellings in _SPELLINGS.items():
        if text in spellings:
            return name
    return ""
