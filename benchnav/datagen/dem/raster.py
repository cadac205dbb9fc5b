"""GeoTIFFs: opened, refused where they do not lie north up in a known place, and read by windows.

rasterio is an extra of this package, imported when a raster is opened. Every refusal ends in a
command that mends the raster; `rio` comes with rasterio. Letters in shapes: K bands, h×w cells.
"""

import json
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchnav.errors import ConfigError, DatasetError

SLACK = 1e-3  # of a cell that an extent may fall short by
_MOST_STRETCH = 0.02  # of a projection; within a UTM zone it is at most 0.001


@dataclass(frozen=True)
class Raster:
    """An open GeoTIFF, north up, with a CRS: what the user calls it, where it is, rasterio's reader."""

    argument: str
    path: Path
    file: Any

    @property
    def cell_m(self) -> tuple[float, float]:
        """Width and height of a cell."""
        return self.file.transform.a, -self.file.transform.e

    def read(self, bands: list[int], rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray]:
        """Reads a window: values, shape [K, h, w], and which cells are missing, bool, shape [h, w]."""
        window = ((rows.start, rows.stop), (columns.start, columns.stop))
        with _naming(self.argument, self.path):
            values = self.file.read(bands, window=window)
            missing = self.file.dataset_mask(window=window) == 0
        return values, missing | ~np.isfinite(values).all(axis=0)


@contextmanager
def opened(argument: str, path: Path, ground: Raster | None = None) -> Iterator[Raster]:
    """Opens a GeoTIFF and checks where it lies: by itself, or that it covers the ground.

    Raises:
        DatasetError: it is none, or does not lie north up in a known place, or not where it should.
    """
    if not path.is_file():
        raise DatasetError(
            f"Expected `{argument}` as a GeoTIFF file, got {path}, which is not there. Check the path."
        )
    with ExitStack() as stack:
        with _naming(argument, path), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a missing place, which is an error below
            raster = Raster(argument, path, stack.enter_context(load_rasterio().open(path, driver="GTiff")))
        _check_place(raster)
        if ground is None:
            _check_projection(raster)
        else:
            _check_covers(raster, ground)
        yield raster


def _check_place(raster: Raster) -> None:
    file, path = raster.file, raster.path
    if file.crs is None:
        raise DatasetError(
            f"Expected `{raster.argument}` with a coordinate reference system (CRS), got {path} without one. "
            f"If you know it, declare it: rio edit-info --crs EPSG:CODE {path}"
        )
    if file.transform.is_identity:
        raise DatasetError(
            f"Expected `{raster.argument}` with a geotransform, which says where it lies and how large its cells "
            f"are, got {path} without one. If you know it: rio edit-info --transform "
            f"'[CELL, 0, WEST, 0, -CELL, NORTH]' {path}"
        )
    a, b, _, d, e, _ = tuple(file.transform)[:6]
    if b or d or a <= 0 or e >= 0:
        raise DatasetError(
            f"Expected `{raster.argument}` north up, got {path} rotated or mirrored. Resample it: "
            + _warp(raster, crs_name(file.crs))
        )


def _check_projection(ground: Raster) -> None:
    file, path = ground.file, ground.path
    utm = _utm_of(ground)
    remedy = f"Reproject it: {_warp(ground, utm or 'EPSG:CODE')}"
    unit = file.crs.linear_units_factor if file.crs.is_projected else (file.crs.units_factor[0], 0)
    if unit[1] != 1:
        raise DatasetError(
            f"Expected `dem` in a projected CRS in metres, got {crs_name(file.crs)} in units of {unit[0]} in "
            f"{path}. {remedy}"
        )
    if utm:
        x, y = _centre(ground)
        eastings, northings = _transformed(file.crs, utm, [x, x + 1000, x], [y, y, y + 1000])
        sides = np.hypot(eastings[1:] - eastings[0], northings[1:] - northings[0])
        if abs(sides / 1000 - 1).max() > _MOST_STRETCH:
            raise DatasetError(
                f"Expected `dem` in a CRS whose metres are metres on the ground, got {crs_name(file.crs)} in {path}, "
                f"where 1000 of them are {sides.min():.0f} m. {remedy}"
            )


def _check_covers(raster: Raster, ground: Raster) -> None:
    crs, wanted = _horizontal(raster.file.crs), _horizontal(ground.file.crs)
    if crs != wanted:
        raise DatasetError(
            f"Expected `{raster.argument}` in the CRS of `dem`, {crs_name(wanted)}, got {crs_name(crs)} in "
            f"{raster.path}. Reproject it: {_warp(raster, crs_name(wanted))}"
        )
    inner, outer, slack = ground.file.bounds, raster.file.bounds, SLACK * max(raster.cell_m)
    gaps = [
        outer.left - inner.left,
        outer.bottom - inner.bottom,
        inner.right - outer.right,
        inner.top - outer.top,
    ]
    if max(gaps) > slack:
        extents = [
            f"x {b.left:.12g} to {b.right:.12g}, y {b.bottom:.12g} to {b.top:.12g}" for b in (inner, outer)
        ]
        raise DatasetError(
            f"Expected `{raster.argument}` to cover `dem`, {extents[0]}, got {extents[1]} in {raster.path}. "
            f"Cut the ground to it: rio clip --like {raster.path} {ground.path} cut.tif"
        )


def _warp(raster: Raster, crs: str) -> str:
    """A command that lays a raster north up in a CRS, with what it leaves bare declared as missing."""
    command = f"rio warp --dst-crs {crs} --resampling {'cubic' if raster.argument == 'dem' else 'nearest'}"
    if raster.file.nodata is None:
        kind = np.dtype(raster.file.dtypes[0])
        bare = np.iinfo(kind).max if kind.kind == "u" else -9999
        command += f" --src-nodata {bare} --dst-nodata {bare}"
    return f"{command} {raster.path} warped.tif"


def _utm_of(raster: Raster) -> str | None:
    """Names the CRS of the UTM zone (or polar cap) that a raster's middle lies in; None off the Earth."""
    x, y = _centre(raster)
    (longitude,), (latitude,) = _transformed(raster.file.crs, "EPSG:4326", [x], [y])
    if not (np.isfinite(longitude) and np.isfinite(latitude)):
        return None
    zone = 61 if latitude > 84 or latitude < -80 else min(int((longitude + 180) // 6) + 1, 60)
    return f"EPSG:{(326 if latitude >= 0 else 327) * 100 + zone}"


def _centre(raster: Raster) -> tuple[float, float]:
    bounds = raster.file.bounds
    return (bounds.left + bounds.right) / 2, (bounds.bottom + bounds.top) / 2


def _transformed(crs: Any, to: str, x: list[float], y: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Moves places from one CRS to another; NaN where there is no way, as from another planet."""
    try:
        moved = load_rasterio().warp.transform(crs, to, x, y)
    except Exception:  # rasterio gives PROJ's failures no public class
        moved = np.full((2, len(x)), np.nan)
    return np.asarray(moved[0]), np.asarray(moved[1])


def _horizontal(crs: Any) -> Any:
    """The part of a CRS that says where on the map, where another says how high."""
    whole = crs.to_dict(projjson=True)
    return type(crs).from_user_input(json.dumps(whole["components"][0])) if "components" in whole else crs


def crs_name(crs: Any) -> str:
    """The code, or the whole text, of the horizontal part of a CRS."""
    return _horizontal(crs).to_string()


@contextmanager
def _naming(argument: str, path: Path) -> Iterator[None]:
    try:
        yield
    except load_rasterio().errors.RasterioError as error:
        reason = " ".join(str(error.__cause__ or error).split())
        raise DatasetError(
            f"Expected `{argument}` as a GeoTIFF, got {path}, which cannot be read as one: {reason} "
            f"Get the file anew, or convert another format: rio convert --format GTiff {path} converted.tif"
        ) from error


def load_rasterio() -> Any:
    """Imports rasterio.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import rasterio.errors
        import rasterio.warp
    except ImportError as error:
        raise ConfigError(
            f"Expected rasterio, which reads GeoTIFFs, got: {error}. Install it: pip install 'benchnav[geo]'"
        ) from error
    return rasterio
