"""Rasters that become layers of a dataset, as they are named on the command line."""

import re
from typing import NamedTuple

import numpy as np

from benchnav.core.errors import expect
from benchnav.core.grid import is_azimuth
from benchnav.datagen import schema
from benchnav.datagen.layers.spec import shipped_fields

# by the end of a layer's name
_UNITS = {
    "_m": "m",
    "_deg": "deg",
    "_s": "s",
    "_mps": "m/s",
    "_k": "K",
}


class LayerRaster(NamedTuple):
    """A raster that becomes a layer: the layer's name, the raster's, and what the layer
    is.
    """

    name: str
    raster: str
    field: schema.Field

    @property
    def how(self) -> str:
        """How it is resampled: angles are no numbers to be averaged."""
        return "nearest" if is_azimuth(self.name) else "average"


def read_layer(text: str) -> LayerRaster:
    """Reads `NAME=RASTER` or `NAME=RASTER:UNIT`; what follows the last colon is a unit
    where it is no path.

    Raises:
        ConfigError: it is not of that form, or the name is no identifier or that of a
            field that is no layer.
    """
    name, equals, rest = text.partition("=")
    place, colon, unit = rest.rpartition(":")
    if not colon or not place or not re.fullmatch(r"[^/\\.]+", unit):
        place, unit = rest, ""
    expect(
        equals and place, f"`layer` as NAME=RASTER or NAME=RASTER:UNIT, got {text!r}."
    )
    schema.check_layer_name(f"the name of a `layer` in {text!r}", name)
    field = shipped_fields().get(name)
    if field is None:
        unit = unit or next(
            (own for end, own in _UNITS.items() if name.endswith(end)), "1"
        )
        field = schema.Field("<f4", ("H", "W"), unit, -np.inf, np.inf, "imported layer")
    expect(
        unit in ("", field.unit),
        f"`layer` {name} in {field.unit}, got {unit!r}. Convert it or leave the unit "
        "out.",
    )
    return LayerRaster(name, place, field)
