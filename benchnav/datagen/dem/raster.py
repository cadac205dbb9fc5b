"""Rasters by any name that GDAL opens, resampled to the maps and read by windows.

rasterio is an extra of this package, imported when a raster is opened. Rows of rasters
run southward; rows of arrays from here run northward, with y. Letters in shapes: K
bands, H×W cells.
"""

import json
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from benchnav.core.errors import ConfigError, DatasetError, expect
from benchnav.core.touched import note_file
from benchnav.datagen.dem.layer import LayerRaster, read_layer

MAX_MAPS = 20_000  # of an import, unless more are allowed
# |scale − 1| of a projection; within a UTM zone it is at most 0.001.
_MAX_STRETCH = 0.02
_PROBE_M = 10.0  # distance over which the scale of a projection is measured
_TOLERANCE = 0.01  # error of positions in another CRS, in cells of the raster


@dataclass(frozen=True, kw_only=True)
class GroundOptions:
    """Reading of an elevation model, and cutting into maps.

    Args:
        dem_unit: Unit of elevations: m, ft, us-ft, or metres in a unit. If empty, the
            unit that the raster declares.
        origin: South-west corner of the first map, [X,Y] in the coordinate reference
            system of the maps.
        max_maps: Maximum number of maps. More stop the import, with a command that
            makes fewer.
        coarse: Allow an elevation model whose cells are three times as wide as the
            maps', or wider.
    """

    dem_unit: str = ""
    origin: tuple[float, float] | None = None
    max_maps: int = MAX_MAPS
    coarse: bool = False

    def __post_init__(self) -> None:
        """Check the number of maps."""
        expect(self.max_maps >= 1, f"`max_maps` ≥ 1, got {self.max_maps}.")


@dataclass(frozen=True, kw_only=True)
class Cut:
    """Selection of the maps of an import.

    Args:
        shares: fraction of the maps of each split.
        scenario: scenario of the recipe that lights the maps.
        stride_m: distance from one map to the next in metres; None for adjacent maps.
        solvable: whether to keep only maps whose goal is reachable, and to store the
            grid reference time.
        ground: reading and cutting of the elevation model.
    """

    shares: Mapping[str, float] = field(default_factory=lambda: {"test/real": 1.0})
    scenario: str = "std"
    stride_m: float | None = None
    solvable: bool = False
    ground: GroundOptions = field(default_factory=GroundOptions)


@dataclass(frozen=True, kw_only=True)
class Rasters:
    """Further rasters of the terrain. Maps that they do not cover are left out.

    Only layers must cover all maps; missing values of a layer are NaN.

    Args:
        classes: Raster of terrain classes. If empty, classes are laid out at random.
        class_ids: Class names by value of that raster, such as '{1: gravel, 9: null}',
            null for no label. If not given, values are class indices.
        random_classes: Allow a photo or measured traversability without classes; they
            are laid out at random.
        unlabelled: Allow a photo and measured traversability without classes; all cells
            are unlabelled.
        photo: Raster of red, green and blue. If empty, cells have the colours of their
            classes.
        traversability: Raster of measured traversability in [0, 1]. If empty, it is
            drawn by the class table.
        layer: A layer as NAME=RASTER or NAME=RASTER:UNIT, such as
            vegetation_m=canopy.tif; several as a list.
    """

    classes: str = ""
    class_ids: dict[int, str | None] | None = None
    random_classes: bool = False
    unlabelled: bool = False
    photo: str = ""
    traversability: str = ""
    layer: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Reject options that contradict each other."""
        expect(
            self.classes or self.class_ids is None,
            "`classes` with `class_ids`, got none. Pass the raster they belong to.",
        )
        expect(
            not (self.classes and self.random_classes),
            "either `classes` or `random_classes`, got both.",
        )
        expect(
            not self.unlabelled
            or (self.photo and not self.classes and not self.random_classes),
            "`unlabelled` with `photo` and without classes, got otherwise: a cell "
            "without a class has the photo's "
            "colour alone. Pass --photo RASTER, or --classes RASTER in place of it.",
        )
        for name in ("photo", "traversability"):
            expect(
                not getattr(self, name)
                or self.classes
                or self.random_classes
                or self.unlabelled,
                f"`classes` with `{name}`, got none: what is real would be joined to "
                "classes laid out at random. "
                "Pass --classes RASTER, --unlabelled for models that need none, or "
                "--random-classes if that is what "
                "you want.",
            )
        names = [layer.name for layer in self.layers]
        twice = sorted({name for name in names if names.count(name) > 1})
        expect(not twice, f"each `layer` once, got {', '.join(twice)} more than once.")

    @property
    def layers(self) -> list[LayerRaster]:
        """Layers of the option `layer`."""
        return [read_layer(text) for text in self.layer]


class Raster(NamedTuple):
    """Open raster.

    Args:
        argument: name of the user's argument.
        name: name of the raster.
        file: rasterio's reader.
        metres: metres per unit of its values.
    """

    argument: str
    name: str
    file: Any
    metres: float = 1.0

    def raw(self, value: float) -> float:
        """Return a value of the first band as stored in the file."""
        return float((value / self.metres - self.file.offsets[0]) / self.file.scales[0])

    @property
    def mask_kinds(self) -> set[str]:
        """GDAL's mask flags; only `all_valid` if the raster declares no missing cells."""
        return {flag.name for flags in self.file.mask_flag_enums for flag in flags}

    @property
    def declares_missing(self) -> bool:
        """Whether some value, mask or band marks cells without a value."""
        return self.mask_kinds != {"all_valid"}

    def place(self) -> tuple[Any, Any, tuple[float, float]]:
        """Return a CRS in metres, bounds in it, and cell size northward and eastward.

        It is the raster's CRS if its metres are metres on the terrain, all over the
        raster. Else it is that of its UTM zone; off the Earth, it is a transverse
        Mercator projection at the raster's centre.

        Raises:
            DatasetError: If there is no such CRS, as for large areas.
        """
        raster_crs = horizontal(self.file.crs)
        bounds = self.file.bounds
        x, y = np.meshgrid(
            np.linspace(bounds.left, bounds.right, 3),
            np.linspace(bounds.bottom, bounds.top, 3),
        )
        middle = x[1, 1], y[1, 1]
        local = local_crs(raster_crs, *middle)
        if local is None:
            raise DatasetError(
                f"Expected `{self.argument}` in a CRS of the Earth or another body, "
                f"got {raster_crs.to_string()[:80]} in {self.name}. If you know it, "
                f"declare it: rio edit-info --crs EPSG:CODE {self.name}"
            )
        for crs in (raster_crs, _utm_of(raster_crs, *middle), local):
            if crs is not None and crs.is_projected and crs.linear_units_factor[1] == 1:
                positions = transformed(raster_crs, crs, x.ravel(), y.ravel()).T
                if (
                    max(stretch(crs, *position) for position in positions)
                    <= _MAX_STRETCH
                ):
                    with self.warped(crs) as warped:
                        return crs, warped.bounds, (warped.res[1], warped.res[0])
        wide, high = bounds.right - bounds.left, bounds.top - bounds.bottom
        raise DatasetError(
            f"Expected `{self.argument}` of ground small enough for a map whose "
            "metres are metres on the ground, got "
            f"{self.name} of {wide:g} × {high:g} units of "
            f"{raster_crs.to_string()[:80]}. Cut out a part: rio clip {self.name} "
            "part.tif --bounds 'WEST SOUTH EAST NORTH'"
        )

    def warped(self, crs: Any, **settings: Any) -> Any:
        """Return the raster in another CRS, with missing cells marked.

        An alpha band is added if the raster has no other mark.
        """
        if (
            self.mask_kinds == {"all_valid"}
            and np.dtype(self.file.dtypes[0]).kind == "f"
        ):
            settings |= {"src_nodata": np.nan, "nodata": np.nan}
        elif not self.mask_kinds & {"nodata", "alpha"}:
            settings |= {"add_alpha": True}
        with _naming(self.argument, self.name):
            return load_rasterio().vrt.WarpedVRT(
                self.file,
                src_crs=horizontal(self.file.crs),
                crs=crs,
                tolerance=_TOLERANCE,
                **settings,
            )

    def laid(self, frame: Mapping[str, Any], bands: list[int], how: str) -> "Layer":
        """Return bands resampled to cells.

        Args:
            frame: the cells of all maps, padded by one: `crs`, `transform`, `height`
                and `width`.
            bands: bands of the raster.
            how: name of one of `rasterio.enums.Resampling`.
        """
        resampling = load_rasterio().enums.Resampling[how]
        # Means of integers need not be integers. With transparency, GDAL requires the
        # dtype of the photo.
        dtype = "float64" if len(bands) == 1 else self.file.dtypes[0]
        return Layer(
            self, bands, self.warped(**frame, resampling=resampling, dtype=dtype)
        )


class Layer(NamedTuple):
    """Bands of a raster, resampled to the cells of all maps, padded by one."""

    raster: Raster
    bands: list[int]
    warped: Any

    def read(self, rows: range, columns: range) -> np.ndarray:
        """Return cells of the maps, padded by one.

        Args:
            rows: rows, counted northward.
            columns: columns, counted eastward.

        Returns:
            Values, NaN if missing, float64, shape [K, len(rows) + 2, len(columns) + 2].
        """
        file, warped = self.raster.file, self.warped
        top = warped.height - 2 - rows.stop
        window = ((top, top + len(rows) + 2), (columns.start, columns.stop + 2))
        with _naming(self.raster.argument, self.raster.name):
            values = warped.read(self.bands, window=window).astype(np.float64)
            if warped.count > file.count:  # an alpha band was added
                mask = warped.read(warped.count, window=window)
            else:
                mask = warped.dataset_mask(window=window)
        values[:, (mask == 0) | ~np.isfinite(values).all(axis=0)] = np.nan
        scales, offsets = np.array([file.scales, file.offsets])[
            :, : len(values), None, None
        ]
        return (values * scales + offsets)[:, ::-1] * self.raster.metres


@contextmanager
def opened(argument: str, name: str, kinds: tuple[str, ...] = ()) -> Iterator[Raster]:
    """Open a raster.

    Args:
        argument: name of the user's argument.
        name: name of the raster.
        kinds: expected dtypes of its first bands; empty for one band of any dtype.

    Raises:
        DatasetError: If it cannot be read, has other bands, or lacks a CRS or a
            geotransform.
    """
    # rasterio warns of a missing geotransform, which is an error below.
    with warnings.catch_warnings(action="ignore"), _naming(argument, name):
        note_file(name)
        file = load_rasterio().open(name)
    with file:
        if file.crs is None:
            raise DatasetError(
                f"Expected `{argument}` with a coordinate reference system (CRS), got "
                f"{name} without one. "
                f"If you know it, declare it: rio edit-info --crs EPSG:CODE {name}"
            )
        if file.transform.is_identity:
            raise DatasetError(
                f"Expected `{argument}` with a geotransform, which says where it lies "
                "and how large its cells "
                f"are, got {name} without one. If you know it: rio edit-info "
                "--transform "
                f"'[CELL, 0, WEST, 0, -CELL, NORTH]' {name}"
            )
        if not kinds and file.count != 1:
            raise DatasetError(
                f"Expected one band in `{argument}`, got {file.count} in {name}. "
                f"Take one out: rio stack --bidx 1 {name} one-band.tif"
            )
        if not kinds and file.dtypes[0].startswith("complex"):
            raise DatasetError(
                f"Expected real numbers in `{argument}`, got {file.dtypes[0]} in "
                f"{name}. If the imaginary parts mean "
                f"nothing, leave them out: rio convert --dtype float64 {name} real.tif"
            )
        if file.dtypes[: len(kinds)] != kinds:
            raise DatasetError(
                f"Expected `{argument}` with first bands {', '.join(kinds)}, got "
                f"{', '.join(file.dtypes)} in {name}. "
                "Convert it: gdal_translate -expand rgb for a palette, rio convert "
                "--dtype uint8 --scale-ratio RATIO "
                "for deeper numbers."
            )
        yield Raster(argument, name, file)


def _utm_of(crs: Any, x: float, y: float) -> Any:
    """Return the CRS of the UTM zone (or polar cap) of a position; None off the Earth."""
    longitude, latitude = transformed(crs, "EPSG:4326", [x], [y])[:, 0]
    if not np.isfinite(longitude + latitude):
        return None
    zone = 61 if not -80 <= latitude <= 84 else min(int((longitude + 180) // 6) + 1, 60)
    return type(crs).from_epsg((326 if latitude >= 0 else 327) * 100 + zone)


def local_crs(crs: Any, x: float, y: float) -> Any:
    """Return a transverse Mercator projection of the same datum, true at a position.

    Args:
        crs: CRS of the position, on any ellipsoid.
        x: eastward, or longitude.
        y: northward, or latitude.

    Returns:
        The CRS; None if there is no geographic CRS of the body.
    """
    base = crs.to_dict(projjson=True)
    while inner := base.get("base_crs") or base.get("source_crs"):
        base = inner
    if base["type"] not in ("GeographicCRS", "GeodeticCRS"):
        return None
    longitude, latitude = transformed(
        crs, type(crs).from_user_input(json.dumps(base)), [x], [y]
    )[:, 0]
    if not np.isfinite(longitude + latitude):
        return None
    parameters = [
        {"name": name, "value": value, "unit": unit}
        for name, value, unit in (
            ("Latitude of natural origin", latitude, "degree"),
            ("Longitude of natural origin", longitude, "degree"),
            ("Scale factor at natural origin", 1, "unity"),
            ("False easting", 0, "metre"),
            ("False northing", 0, "metre"),
        )
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
    """Return |scale − 1| of a projection at a position, in the worst direction.

    It is infinite if the position is not on the body.
    """
    local = local_crs(crs, x, y)
    if local is None:
        return np.inf
    steps = _PROBE_M * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    probes = transformed(crs, local, *(np.array([x, y]) + steps).T).T
    if not np.isfinite(probes).all():
        return np.inf
    differences = probes[::2] - probes[1::2]
    scales = np.linalg.svd(differences, compute_uv=False) / (2 * _PROBE_M)
    return float(np.abs(scales - 1).max())


def transformed(crs: Any, to: Any, x: Any, y: Any) -> np.ndarray:
    """Return N positions in another CRS, shape [2, N].

    They are non-finite if there is no transformation, as from another planet.
    """
    try:
        return np.array(load_rasterio().warp.transform(crs, to, list(x), list(y)))
    except Exception:  # rasterio has no public class for PROJ's errors
        return np.full((2, len(x)), np.nan)


def horizontal(crs: Any) -> Any:
    """Return the horizontal component of a compound CRS; else the CRS itself."""
    components = crs.to_dict(projjson=True).get("components")
    if components is None:
        return crs
    return type(crs).from_user_input(json.dumps(components[0]))


@contextmanager
def _naming(argument: str, name: str) -> Iterator[None]:
    """Convert rasterio's errors to errors that name the raster."""
    try:
        yield
    except load_rasterio().errors.RasterioError as error:
        reason = " ".join(str(error.__cause__ or error).split())
        raise DatasetError(
            f"Expected `{argument}` as a raster that GDAL can read, got {name}: "
            f"{reason}"
        ) from error


def load_rasterio() -> Any:
    """Return rasterio, imported on first use.

    Raises:
        ConfigError: If it is not installed.
    """
    try:
        import rasterio.vrt
        import rasterio.warp
    except ImportError as error:
        raise ConfigError(
            f"Expected rasterio, which reads rasters, got: {error}. Install it: pip "
            "install 'benchnav[geo]'"
        ) from error
    return rasterio
