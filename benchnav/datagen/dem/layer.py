"""Rasters that become layers of a dataset, as named on the command line."""

import re
from typing import NamedTuple

import numpy as np

from benchnav.core.errors import expect
from benchnav.core.grid import is_azimuth
from benchnav.datagen import schema
from benchnav.datagen.layers.spec import shipped_fields

# Units by the suffix of a layer's name.
_UNITS = {"_m": "m", "_deg": "deg", "_s": "s", "_mps": "m/s", "_k": "K"}


class LayerRaster(NamedTuple):
    """Raster that becomes a layer.

    Args:
        name: name of the layer.
        raster: name of the raster.
        field: stored field of the layer.
    """

    name: str
    raster: str
    field: schema.Field

    @property
    def resampling(self) -> str:
        """Resampling in GDAL's terms; angles must not be averaged."""
        return "nearest" if is_azimuth(self.name) else "average"


def read_layer(text: str) -> LayerRaster:
    """Return the layer that a text `NAME=RASTER` or `NAME=RASTER:UNIT` describes.

    The text after the last colon is the unit, unless it looks like a path.

    Raises:
        ConfigError: If the text has another form, or the name or unit is not valid for
            a layer.
    """
    name, equals, source = text.partition("=")
    raster, colon, unit = source.rpartition(":")
    if not colon or not raster or not re.fullmatch(r"[^/\\.]+", unit):
        raster = source
        unit = ""
    expect(
        equals and raster, f"`layer` as NAME=RASTER or NAME=RASTER:UNIT, got {text!r}."
    )
    schema.check_layer_name(f"the name of a `layer` in {text!r}", name)
    field = shipped_fields().get(name)
    if field is None:
        units = (unit for end, unit in _UNITS.items() if name.endswith(end))
        unit = unit or next(units, "1")
        field = schema.Field("<f4", ("H", "W"), unit, -np.inf, np.inf, "imported layer")
    expect(
        unit in ("", field.unit),
        f"`layer` {name} in {field.unit}, got {unit!r}. Convert the raster, or leave "
        "the unit out.",
    )
    return LayerRaster(name, raster, field)
