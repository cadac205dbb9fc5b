"""Coordinate reference systems (CRS) of rasters, and positions in them.

rasterio is an optional dependency of this package. It is imported on first use.
"""

import json
from typing import Any

import numpy as np

from benchnav.core.errors import ConfigError

_PROBE_M = 10.0  # distance over which the scale of a projection is measured


def utm_of(crs: Any, x: float, y: float) -> Any:
    """Return the CRS of the UTM zone (or polar cap) of a position; None off the Earth."""
    longitude, latitude = transformed(crs, "EPSG:4326", [x], [y])[:, 0]
    if not np.isfinite(longitude + latitude):
        return None
    zone = min(int((longitude + 180) // 6) + 1, 60)
    if not -80 <= latitude <= 84:
        zone = 61  # the polar cap
    hemisphere = 326 if latitude >= 0 else 327
    return type(crs).from_epsg(hemisphere * 100 + zone)


def local_crs(crs: Any, x: float, y: float) -> Any:
    """Return a transverse Mercator projection of the same datum, centred at a position.

    Its scale is 1 at the position.

    Args:
        crs: CRS of the position, on any ellipsoid.
        x: eastward coordinate, or longitude, in the unit of `crs`.
        y: northward coordinate, or latitude, in the unit of `crs`.

    Returns:
        The CRS; None if `crs` is not based on a geographic CRS of a body.
    """
    base = crs.to_dict(projjson=True)
    while inner := base.get("base_crs") or base.get("source_crs"):
        base = inner
    if base["type"] not in ("GeographicCRS", "GeodeticCRS"):
        return None
    base_crs = type(crs).from_user_input(json.dumps(base))
    longitude, latitude = transformed(crs, base_crs, [x], [y])[:, 0]
    if not np.isfinite(longitude + latitude):
        return None
    values = (
        ("Latitude of natural origin", latitude, "degree"),
        ("Longitude of natural origin", longitude, "degree"),
        ("Scale factor at natural origin", 1, "unity"),
        ("False easting", 0, "metre"),
        ("False northing", 0, "metre"),
    )
    parameters = [
        {"name": name, "value": value, "unit": unit} for name, value, unit in values
    ]
    axes = [
        {"name": name, "abbreviation": name[0], "direction": direction, "unit": "metre"}
        for name, direction in (("Easting", "east"), ("Northing", "north"))
    ]
    local = {
        "type": "ProjectedCRS",
        "name": f"Transverse Mercator at {latitude:.6f}, {longitude:.6f}",
        "base_crs": base,
        "conversion": {
            "name": "local",
            "method": {"name": "Transverse Mercator"},
            "parameters": parameters,
        },
        "coordinate_system": {"subtype": "Cartesian", "axis": axes},
    }
    return type(crs).from_user_input(json.dumps(local))


def stretch(crs: Any, x: float, y: float) -> float:
    """Return the maximum |scale − 1| of a projection at a position, in any direction.

    The result is infinite if the position is not on the body.

    Args:
        crs: projected CRS.
        x: eastward coordinate in the unit of `crs`.
        y: northward coordinate in the unit of `crs`.
    """
    local = local_crs(crs, x, y)
    if local is None:
        return np.inf
    steps_m = _PROBE_M * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    positions = np.array([x, y]) + steps_m
    probes = transformed(crs, local, *positions.T).T
    if not np.isfinite(probes).all():
        return np.inf
    differences = probes[::2] - probes[1::2]
    scales = np.linalg.svd(differences, compute_uv=False) / (2 * _PROBE_M)
    return float(np.abs(scales - 1).max())


def transformed(crs: Any, to: Any, x: Any, y: Any) -> np.ndarray:
    """Return N positions in another CRS, float64, shape [2, N].

    Args:
        crs: CRS of the positions.
        to: CRS of the result.
        x: eastward coordinates or longitudes, N values.
        y: northward coordinates or latitudes, N values.

    Returns:
        (x, y) of each position, non-finite if there is no transformation, for example
        between planets.
    """
    try:
        return np.array(load_rasterio().warp.transform(crs, to, list(x), list(y)))
    except Exception:  # rasterio has no public class for PROJ's errors
        return np.full((2, len(x)), np.nan)


def horizontal(crs: Any) -> Any:
    """Return the horizontal component of a compound CRS; any other CRS unchanged."""
    components = crs.to_dict(projjson=True).get("components")
    if components is None:
        return crs
    return type(crs).from_user_input(json.dumps(components[0]))


def is_in_metres(crs: Any) -> bool:
    """Return whether a CRS is projected and its unit is the metre."""
    return crs.is_projected and crs.linear_units_factor[1] == 1


def load_rasterio() -> Any:
    """Return rasterio, imported on first use.

    Raises:
        ConfigError: If rasterio is not installed.
    """
    try:
        import rasterio.vrt
        import rasterio.warp
    except ImportError as error:
        raise ConfigError(
            f"Expected rasterio to be installed for reading rasters, got: {error}. "
            "Run: pip install 'benchnav[geo]'"
        ) from error
    return rasterio
