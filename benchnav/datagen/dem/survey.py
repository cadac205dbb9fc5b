"""Reading of rasters, map by map.

Elevation at the resolution of the maps is read without resampling. If the raster's
cells are at most half as wide as the maps', elevation is averaged: otherwise, small
bumps would alias into slopes. Else it is interpolated by cubic convolution. Colours and
traversability are averaged; a cell gets the class that covers most of it. Letters in
shapes: B maps, K bands, H×W cells of a map.
"""

import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from benchnav.core.errors import DatasetError, expect
from benchnav.core.sources import digest_of_path
from benchnav.datagen.dem.drive_cells import (
    BANDS,
    check_enough,
    describe_drives,
    drive_over,
    elevation_under,
    lay_out,
)
from benchnav.datagen.dem.drive_log import Drives, read_drives
from benchnav.datagen.dem.drive_motion import compare_motion, compare_slopes
from benchnav.datagen.dem.extent import Extent
from benchnav.datagen.dem.raster import Cut, Layer, Raster, Rasters, opened
from benchnav.datagen.dem.sentinel import (
    is_certain,
    is_missing,
    looks_missing,
    widest_gap_m,
    zero_gap_m,
)
from benchnav.datagen.dem.tiling import SLACK, Run
from benchnav.datagen.dem.units import check_metres, in_unit
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import FIELDS, OPTIONAL, Maps

# Slope of 80°: natural terrain next to cells of height 0 is less steep.
_CLIFF = 5.67
# Further rasters: argument, dtypes of their bands, and resampling.
_OTHERS = (
    ("classes", (), "mode"),
    ("photo", ("uint8",) * 3, "average"),
    ("traversability", (), "average"),
)


class Survey:
    """Rasters resampled to the cells of all maps.

    Attributes:
        tiling: tiling of the terrain into maps.
        layers: resampled rasters by argument; `NAME min` and `NAME max` are the
            extremes of averaged cells.
        unlabelled: whether all cells lack a class.
        driven: values of driven cells; None without a log.
        arguments: arguments of the rasters; layers are `layer NAME`.
        fields: fields of layers, by name.
        valued: layers of which at least one value was read.
        is_inside: rows and columns of all cells, padded by one, that lie completely on
            the elevation model; two masks.
        indices: index of the class of each raster value; NaN for no label.
        cliff_m: difference of heights of neighbouring cells that no natural terrain
            has.
        source: manifest entry of the rasters.
    """

    def __init__(
        self,
        stack: ExitStack,
        dem: str,
        rasters: Rasters,
        recipe: Recipe,
        cut: Cut,
        drives: Drives | None = None,
        announce: Callable[[str], object] = str,
    ) -> None:
        """Open rasters and resample them to the cells of all maps.

        Args:
            stack: context that closes them.
            dem: raster of elevations, one band, by any name that rasterio opens.
            rasters: further rasters.
            recipe: size and resolution of the maps, class table.
            cut: selection of maps in the terrain.
            drives: log of drives, around which maps are cut; None for all of the
                elevation model.
            announce: receives a description of the import, in sentences.

        Raises:
            ConfigError: If a setting does not fit the recipe.
            DatasetError: If a raster or the log does not fit, or the terrain is too
                small.
        """
        shares, stride_m, options = cut.shares, cut.stride_m, cut.ground
        names, step = [kind.name for kind in recipe.classes], recipe.resolution_m
        named = (
            dict(enumerate(names)) if rasters.class_ids is None else rasters.class_ids
        )
        unknown = sorted(map(str, {*named.values()} - {*names, None}))
        expect(
            not unknown,
            f"`class_ids` to name classes of the recipe, {names}, got {unknown}.",
        )
        log = read_drives(drives) if drives else None
        ground = stack.enter_context(opened("dem", dem))
        ground, unit = in_unit(ground, options.dem_unit)
        crs, bounds, cell_m = ground.place()
        stride = recipe.grid.shape
        if stride_m is not None:
            apart = stride_m / step
            expect(
                apart > 0.5 and abs(apart - round(apart)) < 1e-6,
                f"`stride` as a multiple of the maps' resolution, {step:g} m, got "
                f"{stride_m:g}.",
            )
            stride = round(apart), round(apart)
        if log is not None:
            log = compare_motion(lay_out(log, ground, crs, bounds))
            check_enough(log, list(shares))
        extent = Extent(
            raster=ground,
            unit=unit,
            crs=crs,
            bounds=bounds,
            cell_m=np.array(cell_m),
            shares=shares,
            origin_m=options.origin,
            places_m=None if log is None else log.places_m,
        )
        laid = extent.lay(recipe.grid, stride)
        self.fields = {layer.name: layer.field for layer in rasters.layers}
        tiling, offset_m, how = laid
        self.tiling = tiling
        drive_fields = {
            name: OPTIONAL[name]
            for name in BANDS
            if name in OPTIONAL and log is not None
        }
        announce(extent.describe(laid, recipe, FIELDS | drive_fields | self.fields))
        extent.check(laid, recipe, options)
        south_m, west_m = (extent.corner_m + offset_m).tolist()
        height, width = tiling.cells
        frame = extent.frame(laid, step)
        sources = [(ground, how)]
        for argument, kinds, how in _OTHERS:
            if name := getattr(rasters, argument):
                sources.append(
                    (stack.enter_context(opened(argument, name, kinds)), how)
                )
                extent.suggest_origin(sources[-1][0], laid, step, announce)
        area = (west_m, south_m, west_m + width * step, south_m + height * step)
        for layer_raster in rasters.layers:
            argument = f"layer {layer_raster.name}"
            raster = stack.enter_context(opened(argument, layer_raster.raster))
            extent.suggest_origin(raster, laid, step, announce)
            if layer_raster.field.unit == "m":
                check_metres(raster)
            _check_covers(raster, crs, area, step)
            sources.append((raster, layer_raster.how))
        self.layers: dict[str, Layer] = {}
        for raster, how in sources:
            is_photo = raster.argument == "photo"
            bands = [1, 2, 3] if is_photo else [1]
            is_smoothed = how in ("average", "cubic") and not is_photo
            resamplings = {raster.argument: how}
            for end in ("min", "max") if is_smoothed else ():
                resamplings[f"{raster.argument} {end}"] = end
            for name, resampling in resamplings.items():
                layer = raster.laid(frame, bands, resampling)
                self.layers[name] = layer
                stack.enter_context(layer.warped)
        self.arguments = [raster.argument for raster, _ in sources]
        origins: dict[str, Any] = {
            raster.argument: provenance(raster.name) for raster, _ in sources
        }
        if rasters.classes:
            origins["classes"]["ids"] = {
                str(value): name for value, name in sorted(named.items())
            }
        self.source: dict[str, Any] = {
            "kind": "dem",
            **origins["dem"],
            "crs": crs.to_string(),
            "resolution_m": list(reversed(cell_m)),
            "origin_m": [west_m, south_m],
            "tiles": list(tiling.tiles),
            "stride_m": [cells * step for cells in reversed(tiling.stride)],
            **{argument: origins.get(argument) for argument, _, _ in _OTHERS},
        }
        if ground.metres != 1:
            self.source["metres_per_unit"] = ground.metres
        if self.fields:
            self.source["layers"] = {
                name: origins[f"layer {name}"] for name in self.fields
            }
        self.valued: set[str] = set()
        self.is_inside = []
        for offset, count, size in zip(
            offset_m, tiling.cells, extent.size_m, strict=True
        ):
            edges = offset + step * np.arange(-1, count + 2)
            slack = SLACK * step
            self.is_inside.append((edges[:-1] > -slack) & (edges[1:] < size + slack))
        self.indices = {
            value: np.nan if name is None else names.index(name)
            for value, name in named.items()
        }
        self.unlabelled = rasters.unlabelled
        self.driven = None
        if log is not None:
            positions = (log.places_m - offset_m) / step
            elevation_m = elevation_under(log, self.layers["dem"], *(positions - 0.5).T)
            log = compare_slopes(log, elevation_m)
            cells = np.floor(positions).astype(np.int64)
            log, self.driven = drive_over(log, tiling, *cells.T)
            entry = describe_drives(log, list(shares))
            self.source["drives"] = entry
            self.source["traversability"] = {
                name: entry[name] for name in ("file", "sha256")
            }
        self.cliff_m = _CLIFF * max(*cell_m, step)

    def read(self, run: Run) -> tuple[ndarray, Maps]:
        """Return the inputs of some maps.

        Returns:
            Elevation padded by one cell of the surrounding terrain, shape [B, H + 2, W
            + 2]; and values by the names in `arguments` and in `BANDS`, each of shape
            [B, K, H, W]; NaN if missing.

        Raises:
            DatasetError: If a raster cannot be read, or contains invalid values.
        """
        north, east = self.tiling.stride
        height, width = self.tiling.shape
        south = run.row * north
        wests = [column * east for column in run.columns]
        strip_rows = range(south, south + height)
        strip_columns = range(wests[0], wests[-1] + width)
        padded = Maps()  # by one cell around each map
        for name, layer in self.layers.items():
            strip = layer.read(strip_rows, strip_columns)
            padded[name] = np.stack(
                [strip[:, :, west - wests[0] :][:, :, : width + 2] for west in wests]
            )
        rows, columns = self.is_inside
        for index, west in enumerate(wests):
            values = {name: maps[index] for name, maps in padded.items()}
            ends = [values.get(f"dem {end}", values["dem"]) for end in ("min", "max")]
            low, high = _range("dem", values)
            for odd, heights in zip((low, high), ends, strict=True):
                if is_missing(self.layers["dem"].raster, odd, heights, self.cliff_m):
                    raise self._out_of_range(
                        "dem", "elevations of `dem` without stand-ins", low, high, odd
                    )
            declared_m = widest_gap_m(self.cliff_m)
            for value in (0, -1):
                gap_m = zero_gap_m(ends[0] - value)
                is_declared = self.layers["dem"].raster.declares_missing
                if gap_m > (declared_m if is_declared else self.cliff_m):
                    expected = f"elevations of `dem` without a gap next to {value}"
                    advice = ""
                    if gap_m <= declared_m:  # perhaps the sea
                        advice = (
                            f"Where {value} is a height, declare a value that does not "
                            "occur, such as -9999."
                        )
                    raise self._out_of_range("dem", expected, low, high, value, advice)
            values["dem"][:, ~rows[south:][: height + 2]] = np.nan
            values["dem"][:, :, ~columns[west:][: width + 2]] = np.nan
        if "traversability" in padded:
            low, high = _range("traversability", padded)
            if low < 0 or high > 1:
                expected = "values of `traversability` in [0, 1]"
                raise self._out_of_range(
                    "traversability", expected, low, high, low if low < 0 else high
                )
        for name, kind in self.fields.items():
            low, high = _range(f"layer {name}", padded)
            if low < kind.minimum or high > kind.maximum:
                expected = (
                    f"values of `layer {name}` in [{kind.minimum:g}, {kind.maximum:g}]"
                )
                raise self._out_of_range(
                    f"layer {name}",
                    expected,
                    low,
                    high,
                    low if low < kind.minimum else high,
                )
            if low > high:
                continue
            self.valued.add(name)
            raster = self.layers[f"layer {name}"].raster
            for odd, end in ((low, "min"), (high, "max")):
                key = f"layer {name}"
                extremes = padded.get(f"{key} {end}", padded[key])
                if is_certain(raster, odd, extremes):
                    expected = f"values of `{key}` without stand-ins"
                    advice = ""
                    if not raster.declares_missing:
                        advice = "Where it is a value, declare one that does not occur."
                    raise self._out_of_range(key, expected, low, high, odd, advice)
        inputs = {name: padded[name][:, :, 1:-1, 1:-1] for name in self.arguments}
        if "classes" in inputs:
            inputs["classes"] = self._classes(inputs["classes"])
        elif self.unlabelled:
            inputs["classes"] = np.full_like(inputs["dem"], np.nan)
        if self.driven:
            strip = self.driven.read(strip_rows, strip_columns)
            maps = np.stack(
                [strip[:, :, west - wests[0] :][:, :, :width] for west in wests]
            )
            for band, name in enumerate(BANDS):
                inputs[name] = maps[:, band : band + 1]
        return padded["dem"][:, 0], inputs

    def _out_of_range(
        self,
        name: str,
        expected: str,
        low: float,
        high: float,
        odd: float,
        advice: str = "",
    ) -> DatasetError:
        """Return an error on invalid values, with a command that corrects them.

        Args:
            name: argument of the raster.
            expected: expectation, for the message.
            low: lowest value of a map.
            high: highest value of a map.
            odd: the value that is invalid, perhaps a sentinel.
            advice: further advice, a sentence.
        """
        raster = self.layers[name].raster
        problem = f"Expected {expected}, got {low:g} to {high:g} in {raster.name}."
        value = raster.raw(odd)
        if odd and not looks_missing(raster, odd):
            scaled = (
                "rio calc --not-masked -t float32 '(/ (read 1) 100.0)' "
                f"{raster.name} scaled.tif"
            )
            how = f", from percent so: {scaled}" if name == "traversability" else "."
            return DatasetError(f"{problem} Convert them{how}")
        if raster.file.nodata is None:
            remedy = f"declare it: rio edit-info --nodata {value:.9g} {raster.name}"
            if raster.declares_missing:  # by a mask, which would hide what is declared
                joined = (
                    f"rio calc --profile nodata={value:.9g} '(read 1)' "
                    f"{raster.name} filled.tif"
                )
                remedy = f"join it with the mask: {joined}"
        else:
            now = raster.file.nodata
            chosen = f"(where (== (read 1) {value:.9g}) {now:.9g} (read 1))"
            remedy = (
                f"replace it by what is declared: rio calc '{chosen}' "
                f"{raster.name} filled.tif"
            )
        if advice:
            remedy += f". {advice}"
        return DatasetError(f"{problem} If {value:.9g} stands for missing, {remedy}")

    def _classes(self, values: ndarray) -> ndarray:
        indices = np.full_like(values, np.nan)
        for value, index in self.indices.items():
            indices[values == value] = index
        strange = np.setdiff1d(values[~np.isnan(values)], list(self.indices))
        if len(strange):
            name = self.layers["classes"].raster.name
            shown = [f"{value:g}" for value in strange[:10]]
            if len(strange) > 10:
                shown.append("…")
            raise DatasetError(
                f"Expected values of `classes` in {sorted(self.indices)}, got "
                f"[{', '.join(shown)}] too in {name}. Name each by `class_ids`, null "
                "for no label; or, if one stands for missing, declare it: rio "
                f"edit-info --nodata VALUE {name}"
            )
        return indices


def _check_covers(
    raster: Raster, crs: Any, area: tuple[float, float, float, float], step: float
) -> None:
    """Check that a raster covers all maps to within a cell; values may be missing.

    Args:
        raster: raster of a layer.
        crs: CRS of the maps.
        area: west, south, east and north end of the maps, in metres.
        step: cell width of the maps in metres.

    Raises:
        DatasetError: If it covers only a part, or none.
    """
    with raster.warped(crs) as warped:
        bounds, slack = warped.bounds, max(step, *warped.res)
    ours, theirs = (
        " ".join(f"{value:.10g}" for value in ends) for ends in (area, bounds)
    )
    lacking = np.subtract(bounds, area) * (1, 1, -1, -1)
    if (lacking > slack).any():
        raise DatasetError(
            f"Expected `{raster.argument}` over all of the ground, WEST SOUTH EAST "
            f"NORTH {ours} in {crs.to_string()[:80]}, got {raster.name} over {theirs}. "
            "Take a raster that covers it, with a value for missing where nothing is "
            "known, or cut `dem` out: rio clip DEM part.tif --bounds 'WEST SOUTH EAST "
            "NORTH'"
        )


def _range(name: str, maps: Maps) -> tuple[float, float]:
    """Return minimum and maximum, before averaging."""
    low, high = (maps.get(f"{name} {end}", maps[name]) for end in ("min", "max"))
    minimum = np.fmin.reduce(low, None, initial=np.inf)
    maximum = np.fmax.reduce(high, None, initial=-np.inf)
    return float(minimum), float(maximum)


def provenance(name: str) -> dict[str, str | None]:
    """Return the name of a raster, and the SHA-256 of a file.

    Credentials and queries of addresses are removed, since they may be secret.
    """
    path = Path(name)
    if path.is_file():
        return {"file": path.name, "sha256": digest_of_path(path)}
    return {"file": re.sub("//[^/@]*@", "//", name).partition("?")[0], "sha256": None}
