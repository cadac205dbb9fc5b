"""Units of length that rasters declare, or leave out."""

import numpy as np

from benchnav.core.errors import DatasetError, expect
from benchnav.datagen.dem.raster import Raster, horizontal

UNITS_M = {"m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}  # by the names of PROJ
# How rasters write units, in lower case, by what `dem_unit` takes.
_SPELLINGS = {
    "m": ("m", "metre", "meter", "metres", "meters"),
    "ft": ("ft", "foot", "feet", "international foot", "international feet"),
    "us-ft": ("us-ft", "ftus", "us survey foot", "us survey feet", "us_survey_foot", "foot_us", "us foot"),
    "0.1": ("dm", "decimetre", "decimeter", "decimetres", "decimeters"),
    "0.01": ("cm", "centimetre", "centimeter", "centimetres", "centimeters"),
    "1000": ("km", "kilometre", "kilometer", "kilometres", "kilometers"),
}


def in_unit(dem: Raster, unit: str) -> tuple[Raster, str]:
    """Return an elevation model with its unit, and where that comes from, in words.

    Args:
        dem: Elevation model, one band.
        unit: A name of `UNITS_M`, or metres in a unit as text; if empty, what the raster declares.

    Raises:
        ConfigError: If the unit is neither.
        DatasetError: If it is empty and the raster is not sure to be in metres.
    """
    declared, crs = dem.file.units[0] or "", horizontal(dem.file.crs)
    if unit:
        try:
            metres = UNITS_M.get(unit) or float(unit)
        except ValueError:
            metres = np.nan
        expect(
            0 < metres < np.inf,
            f"`dem_unit` among {', '.join(UNITS_M)}, or as metres in a unit, such as 0.01, got {unit!r}.",
        )
        instead = f", where the raster declares {declared!r}" if declared else ""
        return dem._replace(metres=metres), f"{unit} as set by `dem_unit`{instead}"
    if declared.lower() in _SPELLINGS["m"]:
        return dem, "metres as the raster declares"
    if declared:
        near = next((name for name, words in _SPELLINGS.items() if declared.lower() in words), "")
        option = f"--dem-unit {near}" if near else "--dem-unit with the metres in one, such as 0.01"
        raise DatasetError(
            f"Expected elevations of `dem` in metres, got {declared!r} in {dem.name}. To convert them, pass {option}; "
            "if they are metres all the same, pass --dem-unit m."
        )
    if crs.is_projected and crs.linear_units_factor[1] != 1:
        raise DatasetError(
            f"Expected a unit of the elevations of `dem`, since {dem.name} is in {crs.linear_units_factor[0]} and "
            "declares none, got neither. Pass --dem-unit us-ft, --dem-unit ft or --dem-unit m, whichever it is."
        )
    return dem, "metres (the raster declares no unit: if others, set `dem_unit`)"


def check_metres(raster: Raster) -> None:
    """Reject a raster of metres that declares another unit of length.

    Raises:
        DatasetError: If it does, with a command that converts it.
    """
    declared = raster.file.units[0] or ""
    unit = next((name for name, words in _SPELLINGS.items() if declared.lower() in words), "m")
    if unit != "m":
        metres = UNITS_M.get(unit) or float(unit)
        whole = "--not-masked " * (raster.file.nodata is None)
        raise DatasetError(
            f"Expected `{raster.argument}` in metres, got {declared!r} in {raster.name}. Convert it: "
            f"rio calc {whole}-t float32 '(* {metres:.10g} (read 1))' {raster.name} metres.tif"
        )
