"""Rasters by any name that GDAL opens, laid on the cells of the maps by GDAL's warper
and read by windows.

rasterio is an extra of this package, imported when a raster is opened. A raster's rows
run southward; what is read here runs northward, with y. Letters in shapes: K bands, H×W
cells.
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
_MOST_STRETCH = (
    0.02  # of a projection against the ground; within a UTM zone it is at most 0.001
)
_PROBE_M = 10.0  # to either side of a place where the scale of a projection is measured
_TOLERANCE = 0.01  # of a raster's cell that a place may be off by in another CRS


@dataclass(frozen=True, kw_only=True)
class GroundOptions:
    """How an elevation model is read and cut into maps.

    Args:
        dem_unit: Unit of elevations: m, ft, us-ft, or metres in a unit; if empty, what
            the raster declares.
        origin: Where the first map's south-west corner lies, [X,Y] in the coordinate
            reference system of the maps.
        max_maps: Most maps; ground of more stops the import, with a command that makes
            fewer.
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
    """Which maps an import cuts out of the ground.

    Args:
        shares: of the maps, by split.
        scenario: which of the recipe's scenarios lights the maps.
        stride_m: from one map to the next; None for maps side by side.
        solvable: keep only maps whose goal can be reached, and store the grid reference
            time.
        ground: how the elevation model is read and cut.
    """

    shares: Mapping[str, float] = field(default_factory=lambda: {"test/real": 1.0})
    scenario: str = "std"
    stride_m: float | None = None
    solvable: bool = False
    ground: GroundOptions = field(default_factory=GroundOptions)


@dataclass(frozen=True, kw_only=True)
class Rasters:
    """What there is of the ground beside its elevation. Where a raster does not cover
    it, maps are left out.

    A layer alone has to cover all maps; where it has no value, it is NaN.

    Args:
        classes: Raster of terrain classes; laid out at random when not given.
        class_ids: Class names by value of that raster, such as '{1: gravel, 9: null}',
            null for no label; else indices.
        random_classes: Allow a photo or measured traversability without classes: these
            are laid out at random.
        unlabelled: Allow a photo and measured traversability without classes: no cell
            has one.
        photo: Raster of red, green and blue; painted by the class when not given.
        traversability: Raster of measured traversability in [0, 1]; drawn by the class
            table when not given.
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
        """Refuses what does not go together."""
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
        """What `layer` says, read."""
        return [read_layer(text) for text in self.layer]


class Raster(NamedTuple):
    """An open raster: what the user calls it, its name, rasterio's reader, and metres
    per unit of its values.
    """

    argument: str
    name: str
    file: Any
    metres: float = 1.0

    def raw(self, value: float) -> float:
        """Return a value of the first band as the file holds it."""
        return float((value / self.metres - self.file.offsets[0]) / self.file.scales[0])

    @property
    def mask_kinds(self) -> set[str]:
        """How it tells cells without a value, in GDAL's words; `all_valid` alone where
        it does not.
        """
        return {flag.name for flags in self.file.mask_flag_enums for flag in flags}

    @property
    def declares_missing(self) -> bool:
        """Whether some value, mask or band marks cells without a value."""
        return self.mask_kinds != {"all_valid"}

    def place(self) -> tuple[Any, Any, tuple[float, float]]:
        """Where it lies: a CRS in metres, its bounds there, and the size of its cells
        northward and eastward.

        The CRS is its own where a metre of that is one on the ground, all over the
        raster. Else it is that of its UTM zone, and off the Earth a transverse Mercator
        projection of the raster's middle.

        Raises:
            DatasetError: there is none, as of ground that is too large.
        """
        own, bounds = horizontal(self.file.crs), self.file.bounds
        x, y = np.meshgrid(
            np.linspace(bounds.left, bounds.right, 3),
            np.linspace(bounds.bottom, bounds.top, 3),
        )
        middle = x[1, 1], y[1, 1]
        local = local_crs(own, *middle)
        if local is None:
            raise DatasetError(
                f"Expected `{self.argument}` in a CRS of the Earth or another body, "
                f"got {own.to_string()[:80]} in "
                f"{self.name}. If you know it, declare it: rio edit-info --crs "
                f"EPSG:CODE {self.name}"
            )
        for crs in (own, _utm_of(own, *middle), local):
            if crs is not None and crs.is_projected and crs.linear_units_factor[1] == 1:
                places = transformed(own, crs, x.ravel(), y.ravel()).T
                if max(stretch(crs, *place) for place in places) <= _MOST_STRETCH:
                    with self.warped(crs) as warped:
                        return crs, warped.bounds, (warped.res[1], warped.res[0])
        wide, high = bounds.right - bounds.left, bounds.top - bounds.bottom
        raise DatasetError(
            f"Expected `{self.argument}` of ground small enough for a map whose "
            "metres are metres on the ground, got "
            f"{self.name} of {wide:g} × {high:g} units of {own.to_string()[:80]}. "
            f"Cut out a part: rio clip {self.name} part.tif --bounds 'WEST SOUTH EAST "
            "NORTH'"
        )

    def warped(self, crs: Any, **settings: Any) -> Any:
        """The raster in another CRS; where it has no values, that shows, if need be by
        one more band.
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
        """Lays bands of it on cells, resampled in one of GDAL's ways.

        Args:
            frame: the cells of all maps and one around them: `crs`, `transform`,
                `height` and `width`.
            bands: which bands.
            how: name of one of `rasterio.enums.Resampling`.
        """
        resampling = load_rasterio().enums.Resampling[how]
        # Of whole numbers the means need not be whole; with transparency GDAL wants a
        # photo's own type.
        dtype = "float64" if len(bands) == 1 else self.file.dtypes[0]
        return Layer(
            self, bands, self.warped(**frame, resampling=resampling, dtype=dtype)
        )


class Layer(NamedTuple):
    """The first bands of a raster as resampled to the cells of all maps and one around
    them.
    """

    raster: Raster
    bands: list[int]
    warped: Any

    def read(self, rows: range, columns: range) -> np.ndarray:
        """Reads cells of the maps and one cell around them.

        Args:
            rows: counted northward.
            columns: counted eastward.

        Returns:
            Values, NaN where there are none, float64, shape [K, len(rows) + 2,
            len(columns) + 2].
        """
        file, warped = self.raster.file, self.warped
        top = warped.height - 2 - rows.stop
        window = ((top, top + len(rows) + 2), (columns.start, columns.stop + 2))
        with _naming(self.raster.argument, self.raster.name):
            values = warped.read(self.bands, window=window).astype(np.float64)
            if warped.count > file.count:  # one more band says where there are values
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
    """Opens a raster.

    Args:
        argument: what the user calls it.
        name: where it is.
        kinds: dtypes of its first bands; none for one band of any.

    Raises:
        DatasetError: it cannot be read, holds other bands, or does not say where it
            lies.
    """
    # Rasterio warns of a missing place, which is an error below.
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
    """The CRS of the UTM zone (or polar cap) that a place lies in; None off the Earth."""
    longitude, latitude = transformed(crs, "EPSG:4326", [x], [y])[:, 0]
    if not np.isfinite(longitude + latitude):
        return None
    zone = 61 if not -80 <= latitude <= 84 else min(int((longitude + 180) // 6) + 1, 60)
    return type(crs).from_epsg((326 if latitude >= 0 else 327) * 100 + zone)


def local_crs(crs: Any, x: float, y: float) -> Any:
    """A transverse Mercator projection of the same body and datum, true to scale at a
    place; None where it has none.

    Args:
        crs: of the place, on any ellipsoid.
        x: eastward, or longitude.
        y: northward, or latitude.
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
    """How far a metre of a projection in metres is from one on the ground at a place,
    in the worst direction.

    Returns:
        |scale − 1|; infinite where the place is not on the ground.
    """
    local = local_crs(crs, x, y)
    if local is None:
        return np.inf
    steps = _PROBE_M * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    moved = transformed(crs, local, *(np.array([x, y]) + steps).T).T
    if not np.isfinite(moved).all():
        return np.inf
    scales = np.linalg.svd(moved[::2] - moved[1::2], compute_uv=False) / (2 * _PROBE_M)
    return float(np.abs(scales - 1).max())


def transformed(crs: Any, to: Any, x: Any, y: Any) -> np.ndarray:
    """Moves N places from one CRS to another, shape [2, N]; not finite where no way
    leads, as from another planet.
    """
    try:
        return np.array(load_rasterio().warp.transform(crs, to, list(x), list(y)))
    except Exception:  # rasterio gives PROJ's failures no public class
        return np.full((2, len(x)), np.nan)


def horizontal(crs: Any) -> Any:
    """The part of a CRS that says where on the map, where another says how high."""
    whole = crs.to_dict(projjson=True)
    return (
        type(crs).from_user_input(json.dumps(whole["components"][0]))
        if "components" in whole
        else crs
    )


@contextmanager
def _naming(argument: str, name: str) -> Iterator[None]:
    """Says which raster could not be read, and why."""
    try:
        yield
    except load_rasterio().errors.RasterioError as error:
        reason = " ".join(str(error.__cause__ or error).split())
        raise DatasetError(
            f"Expected `{argument}` as a raster that GDAL can read, got {name}: "
            f"{reason}"
        ) from error


def load_rasterio() -> Any:
    """Imports rasterio.

    Raises:
        ConfigError: it is not installed.
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
