"""Rasters by any name that GDAL opens, resampled to the maps and read by windows.

Rows of rasters run southward; rows of the arrays that this module returns run
northward, with y. Letters in shapes: K bands.
"""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from benchnav.core.errors import DatasetError
from benchnav.core.touched import note_file
from benchnav.datagen.dem.crs import (
    horizontal,
    is_in_metres,
    load_rasterio,
    local_crs,
    stretch,
    transformed,
    utm_of,
)

# Maximum |scale − 1| of a projection. Within a UTM zone, it is at most 0.001.
_MAX_STRETCH = 0.02
_TOLERANCE = 0.01  # maximum error of positions in another CRS, in cells of the raster


class Raster(NamedTuple):
    """Open raster.

    Args:
        argument: name of the user's argument.
        name: path or URL of the raster.
        file: rasterio's reader.
        metres: metres per unit of the values.
    """

    argument: str
    name: str
    file: Any
    metres: float = 1.0

    def raw(self, value: float) -> float:
        """Return the number that the file stores for a value of the first band."""
        scaled = value / self.metres - self.file.offsets[0]
        return float(scaled / self.file.scales[0])

    @property
    def mask_kinds(self) -> set[str]:
        """GDAL's mask flags; only `all_valid` if no mark for missing cells exists."""
        return {flag.name for flags in self.file.mask_flag_enums for flag in flags}

    @property
    def declares_missing(self) -> bool:
        """Whether the raster declares a value, mask or band for missing cells."""
        return self.mask_kinds != {"all_valid"}

    def georeference(self) -> tuple[Any, Any, tuple[float, float]]:
        """Return a CRS in metres, and the raster's bounds and cell size in this CRS.

        The CRS is the first of these with a scale of nearly 1 everywhere in the raster:
        the raster's CRS, the CRS of the UTM zone, or a transverse Mercator projection
        at the raster's centre.

        Returns:
            CRS; bounds; cell size northward and eastward in metres.

        Raises:
            DatasetError: If no CRS has such a scale, for example on a large area.
        """
        raster_crs = horizontal(self.file.crs)
        bounds = self.file.bounds
        xs = np.linspace(bounds.left, bounds.right, 3)
        ys = np.linspace(bounds.bottom, bounds.top, 3)
        x, y = np.meshgrid(xs, ys)
        middle = x[1, 1], y[1, 1]
        local = local_crs(raster_crs, *middle)
        if local is None:
            raise DatasetError(
                f"Expected `{self.argument}` in a CRS of the Earth or another body, "
                f"got {raster_crs.to_string()[:80]} in {self.name}. If you know its "
                f"CRS, declare it: rio edit-info --crs EPSG:CODE {self.name}"
            )
        for crs in (raster_crs, utm_of(raster_crs, *middle), local):
            if crs is None or not is_in_metres(crs):
                continue
            positions = transformed(raster_crs, crs, x.ravel(), y.ravel()).T
            worst = max(stretch(crs, *position) for position in positions)
            if worst <= _MAX_STRETCH:
                with self.warped(crs) as warped:
                    return crs, warped.bounds, (warped.res[1], warped.res[0])
        width = bounds.right - bounds.left
        height = bounds.top - bounds.bottom
        raise DatasetError(
            f"Expected `{self.argument}` of terrain small enough for a projection "
            f"whose scale is within {_MAX_STRETCH:.0%} of 1, got "
            f"{self.name} of {width:g} × {height:g} units of "
            f"{raster_crs.to_string()[:80]}. Cut out a part: rio clip {self.name} "
            "part.tif --bounds 'WEST SOUTH EAST NORTH'"
        )

    def warped(self, crs: Any, **settings: Any) -> Any:
        """Return the raster in another CRS, with missing cells marked.

        An alpha band is added if the result would otherwise not mark missing cells.
        """
        is_float = np.dtype(self.file.dtypes[0]).kind == "f"
        if is_float and not self.declares_missing:
            settings |= {"src_nodata": np.nan, "nodata": np.nan}
        elif not self.mask_kinds & {"nodata", "alpha"}:
            settings |= {"add_alpha": True}
        with _named_errors(self.argument, self.name):
            return load_rasterio().vrt.WarpedVRT(
                self.file,
                src_crs=horizontal(self.file.crs),
                crs=crs,
                tolerance=_TOLERANCE,
                **settings,
            )

    def resampled(
        self, frame: Mapping[str, Any], bands: list[int], resampling: str
    ) -> "Layer":
        """Return bands of the raster, resampled to the cells of all maps.

        Args:
            frame: cells of all maps, padded by one: `crs`, `transform`, `height` and
                `width`.
            bands: numbers of the bands, from 1.
            resampling: name of one of `rasterio.enums.Resampling`.
        """
        method = load_rasterio().enums.Resampling[resampling]
        # GDAL requires that a photo with transparency keeps its dtype.
        dtype = self.file.dtypes[0]
        if len(bands) == 1:
            dtype = "float64"  # means of integers need not be integers
        warped = self.warped(**frame, resampling=method, dtype=dtype)
        return Layer(self, bands, warped)


class Layer(NamedTuple):
    """Bands of a raster, resampled to the cells of all maps, padded by one cell.

    Args:
        raster: raster of the bands.
        bands: numbers of the bands, from 1.
        warped: rasterio's view of the resampled raster.
    """

    raster: Raster
    bands: list[int]
    warped: Any

    def read(self, rows: range, columns: range) -> np.ndarray:
        """Return the values of some rows and columns, padded by one cell.

        Args:
            rows: indices of the rows, counted northward.
            columns: indices of the columns, counted eastward.

        Returns:
            Values, NaN if missing, float64, shape [K, len(rows) + 2, len(columns) + 2].
        """
        file = self.raster.file
        warped = self.warped
        top = warped.height - 2 - rows.stop
        window_rows = (top, top + len(rows) + 2)
        window_columns = (columns.start, columns.stop + 2)
        window = (window_rows, window_columns)
        with _named_errors(self.raster.argument, self.raster.name):
            values = warped.read(self.bands, window=window).astype(np.float64)
            if warped.count > file.count:  # an alpha band was added
                mask = warped.read(warped.count, window=window)
            else:
                mask = warped.dataset_mask(window=window)
        is_missing = (mask == 0) | ~np.isfinite(values).all(axis=0)
        values[:, is_missing] = np.nan
        scales = np.array(file.scales)[: len(values), None, None]
        offsets = np.array(file.offsets)[: len(values), None, None]
        northward = (values * scales + offsets)[:, ::-1]
        return northward * self.raster.metres


@contextmanager
def open_raster(
    argument: str, name: str, kinds: tuple[str, ...] = ()
) -> Iterator[Raster]:
    """Open a raster.

    Args:
        argument: name of the user's argument.
        name: path or URL of the raster.
        kinds: expected dtypes of the first bands; empty for exactly one band of any
            real dtype.

    Raises:
        DatasetError: If the raster cannot be read, does not have the expected bands, or
            lacks a CRS or a geotransform.
    """
    # rasterio warns of a missing geotransform, which is an error below.
    with warnings.catch_warnings(action="ignore"), _named_errors(argument, name):
        note_file(name)
        file = load_rasterio().open(name)
    with file:
        _check_georeference(argument, name, file)
        _check_bands(argument, name, file, kinds)
        yield Raster(argument, name, file)


def _check_georeference(argument: str, name: str, file: Any) -> None:
    """Check that a raster has a CRS and a geotransform."""
    if file.crs is None:
        raise DatasetError(
            f"Expected `{argument}` with a coordinate reference system (CRS), got "
            f"{name} without one. "
            f"If you know it, declare it: rio edit-info --crs EPSG:CODE {name}"
        )
    if file.transform.is_identity:
        raise DatasetError(
            f"Expected `{argument}` with a geotransform (position and cell size), got "
            f"{name} without one. If you know it, declare it: rio edit-info "
            f"--transform '[CELL, 0, WEST, 0, -CELL, NORTH]' {name}"
        )


def _check_bands(argument: str, name: str, file: Any, kinds: tuple[str, ...]) -> None:
    """Check the first bands of a raster; see `open_raster`."""
    if not kinds and file.count != 1:
        raise DatasetError(
            f"Expected one band in `{argument}`, got {file.count} in {name}. "
            f"Extract one band: rio stack --bidx 1 {name} one-band.tif"
        )
    if not kinds and file.dtypes[0].startswith("complex"):
        raise DatasetError(
            f"Expected real numbers in `{argument}`, got {file.dtypes[0]} in "
            f"{name}. If the imaginary parts have "
            f"no meaning, drop them: rio convert --dtype float64 {name} real.tif"
        )
    if file.dtypes[: len(kinds)] != kinds:
        raise DatasetError(
            f"Expected `{argument}` with first bands {', '.join(kinds)}, got "
            f"{', '.join(file.dtypes)} in {name}. "
            "Convert a palette with gdal_translate -expand rgb, and numbers of more "
            "than 8 bits with rio convert --dtype uint8 --scale-ratio RATIO."
        )


@contextmanager
def _named_errors(argument: str, name: str) -> Iterator[None]:
    """Convert rasterio's errors to errors that name the raster."""
    try:
        yield
    except load_rasterio().errors.RasterioError as error:
        reason = " ".join(str(error.__cause__ or error).split())
        raise DatasetError(
            f"Expected `{argument}` to be a raster that GDAL can read, got {name}: "
            f"{reason}"
        ) from error
