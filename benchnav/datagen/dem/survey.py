"""What rasters say of the ground, map by map.

Elevation is the raster's own at its own resolution. Where its cells are at most half as
wide as the maps', it is averaged, so that bumps too small for the maps do not fold into
slopes of theirs; else it is interpolated by cubic convolution. Colours and
traversability are averaged; a cell takes the class that
covers most of it. Letters in shapes: B maps, K bands, H×W cells of a map.
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

_CLIFF = (
    5.67  # of 80°, metres a metre: steeper than natural ground beside cells of height 0
)
# Rasters beside the elevation model: what the user calls them, dtypes of their bands,
# and how they are resampled.
_OTHERS = (
    ("classes", (), "mode"),
    ("photo", ("uint8",) * 3, "average"),
    ("traversability", (), "average"),
)


class Survey:
    """Rasters laid on the cells of all maps.

    Attributes:
        tiling: how the ground is cut into maps.
        layers: by what the user calls the raster; under `NAME min` and `NAME max` what
            is averaged there.
        unlabelled: whether no cell has a class.
        driven: what drives say of the cells; None without a log.
        given: what the user calls each raster; layers are `layer NAME`.
        fields: those of layers, by name.
        valued: layers of which some value was read.
        known: which rows and columns of all cells, framed by one, lie wholly on the
            elevation model.
        indices: of classes, by value of their raster; NaN for no label.
        cliff_m: difference of heights that no natural ground has next to a cell.
        source: what the manifest says of the rasters.
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
        """Opens rasters and lays them on the cells of all maps.

        Args:
            stack: closes them.
            dem: of elevations, one band, by any name that rasterio opens.
            rasters: the others.
            recipe: size and resolution of the maps, class table.
            cut: which maps are cut out of the ground.
            drives: log of drives, around which the ground is cut; None for all of the
                elevation model.
            announce: is given what will be imported, in sentences.

        Raises:
            ConfigError: a setting does not fit the recipe.
            DatasetError: a raster or the log does not fit, or the ground is too small.
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
        self.fields = {own.name: own.field for own in rasters.layers}
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
        for own in rasters.layers:
            raster = stack.enter_context(opened(f"layer {own.name}", own.raster))
            extent.suggest_origin(raster, laid, step, announce)
            if own.field.unit == "m":
                check_metres(raster)
            _check_covers(raster, crs, area, step)
            sources.append((raster, own.how))
        self.layers: dict[str, Layer] = {}
        for raster, how in sources:
            is_photo = raster.argument == "photo"
            ends = (
                ("min", "max") if how in ("average", "cubic") and not is_photo else ()
            )
            for way in (how, *ends):
                layer = raster.laid(frame, [1, 2, 3] if is_photo else [1], way)
                self.layers[raster.argument + f" {way}" * (way in ends)] = layer
                stack.enter_context(layer.warped)
        self.given = [raster.argument for raster, _ in sources]
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
        self.known = []
        for offset, count, size in zip(
            offset_m, tiling.cells, extent.size_m, strict=True
        ):
            edges = offset + step * np.arange(-1, count + 2)
            self.known.append(
                (edges[:-1] > -SLACK * step) & (edges[1:] < size + SLACK * step)
            )
        self.indices = {
            value: np.nan if name is None else names.index(name)
            for value, name in named.items()
        }
        self.unlabelled, self.driven = rasters.unlabelled, None
        if log is not None:
            cells_of = (log.places_m - offset_m) / step
            log = compare_slopes(
                log, elevation_under(log, self.layers["dem"], *(cells_of - 0.5).T)
            )
            log, self.driven = drive_over(
                log, tiling, *np.floor(cells_of).astype(np.int64).T
            )
            self.source["drives"] = about = describe_drives(log, list(shares))
            self.source["traversability"] = {
                name: about[name] for name in ("file", "sha256")
            }
        self.cliff_m = _CLIFF * max(*cell_m, step)

    def read(self, run: Run) -> tuple[ndarray, Maps]:
        """Reads some maps.

        Returns:
            Elevation with one cell of the ground beyond, shape [B, H + 2, W + 2], and
            by the names in `given` and in `BANDS` what others say, shape [B, K, H, W];
            NaN where there is nothing.

        Raises:
            DatasetError: a raster cannot be read, or holds what it should not.
        """
        (north, east), (height, width) = self.tiling.stride, self.tiling.shape
        south, wests = run.row * north, [column * east for column in run.columns]
        framed = Maps()  # each map by a cell
        for name, layer in self.layers.items():
            strip = layer.read(
                range(south, south + height), range(wests[0], wests[-1] + width)
            )
            framed[name] = np.stack(
                [strip[:, :, west - wests[0] :][:, :, : width + 2] for west in wests]
            )
        rows, columns = self.known
        for place, west in enumerate(wests):
            own = {name: maps[place] for name, maps in framed.items()}
            ends = [own.get(f"dem {end}", own["dem"]) for end in ("min", "max")]
            low, high = _range("dem", own)
            for odd, heights in zip((low, high), ends, strict=True):
                if is_missing(self.layers["dem"].raster, odd, heights, self.cliff_m):
                    raise self._out_of_range(
                        "dem", "elevations of `dem` without stand-ins", low, high, odd
                    )
            declared_m = widest_gap_m(self.cliff_m)
            for value in (0, -1):
                gap_m = zero_gap_m(ends[0] - value)
                if gap_m > (
                    declared_m
                    if self.layers["dem"].raster.declares_missing
                    else self.cliff_m
                ):
                    expected = f"elevations of `dem` without a gap next to {value}"
                    is_sea = gap_m <= declared_m
                    other = (
                        f"Where {value} is a height, declare a value that does not "
                        "occur, such as -9999." * is_sea
                    )
                    raise self._out_of_range("dem", expected, low, high, value, other)
            own["dem"][:, ~rows[south:][: height + 2]] = np.nan
            own["dem"][:, :, ~columns[west:][: width + 2]] = np.nan
        if "traversability" in framed:
            low, high = _range("traversability", framed)
            if low < 0 or high > 1:
                expected = "values of `traversability` in [0, 1]"
                raise self._out_of_range(
                    "traversability", expected, low, high, low if low < 0 else high
                )
        for name, kind in self.fields.items():
            low, high = _range(f"layer {name}", framed)
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
                if is_certain(
                    raster,
                    odd,
                    framed.get(f"layer {name} {end}", framed[f"layer {name}"]),
                ):
                    expected = f"values of `layer {name}` without stand-ins"
                    other = "Where it is a value, declare one that does not occur." * (
                        not raster.declares_missing
                    )
                    raise self._out_of_range(
                        f"layer {name}", expected, low, high, odd, other
                    )
        given = {name: framed[name][:, :, 1:-1, 1:-1] for name in self.given}
        if "classes" in given:
            given["classes"] = self._classes(given["classes"])
        elif self.unlabelled:
            given["classes"] = np.full_like(given["dem"], np.nan)
        if self.driven:
            strip = self.driven.read(
                range(south, south + height), range(wests[0], wests[-1] + width)
            )
            maps = np.stack(
                [strip[:, :, west - wests[0] :][:, :, :width] for west in wests]
            )
            given |= {
                name: maps[:, place : place + 1] for place, name in enumerate(BANDS)
            }
        return framed["dem"][:, 0], given

    def _out_of_range(
        self,
        name: str,
        expected: str,
        low: float,
        high: float,
        odd: float,
        other: str = "",
    ) -> DatasetError:
        """Return an error that names a value as missing where it looks so, with a
        command that declares it.
        """
        raster = self.layers[name].raster
        said = f"Expected {expected}, got {low:g} to {high:g} in {raster.name}."
        value = raster.raw(odd)
        if odd and not looks_missing(raster, odd):
            scaled = (
                "rio calc --not-masked -t float32 '(/ (read 1) 100.0)' "
                f"{raster.name} scaled.tif"
            )
            how = f", from percent so: {scaled}" if name == "traversability" else "."
            return DatasetError(f"{said} Convert them{how}")
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
        return DatasetError(
            f"{said} If {value:.9g} stands for missing, "
            f"{remedy}{other and f'. {other}'}"
        )

    def _classes(self, values: ndarray) -> ndarray:
        indices = np.full_like(values, np.nan)
        for value, index in self.indices.items():
            indices[values == value] = index
        strange = np.setdiff1d(values[~np.isnan(values)], list(self.indices))
        if len(strange):
            name = self.layers["classes"].raster.name
            few = ", ".join(f"{value:g}" for value in strange[:10]) + (
                ", …" if len(strange) > 10 else ""
            )
            raise DatasetError(
                f"Expected values of `classes` in {sorted(self.indices)}, got [{few}] "
                f"too in {name}. Name each by "
                "`class_ids`, null for no label; or, if one stands for missing, "
                "declare it: "
                f"rio edit-info --nodata VALUE {name}"
            )
        return indices


def _check_covers(
    raster: Raster, crs: Any, area: tuple[float, float, float, float], step: float
) -> None:
    """Refuses a raster that does not reach over all maps, but for a cell; within it
    values may be missing.

    Args:
        raster: of a layer.
        crs: of the maps.
        area: west, south, east and north end of the maps, in metres.
        step: cell width of the maps.

    Raises:
        DatasetError: it lies elsewhere, or covers a part.
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
            f"NORTH {ours} in "
            f"{crs.to_string()[:80]}, got {raster.name} over {theirs}. Take a raster "
            "that covers it, with a value for "
            "missing where nothing is known, or cut `dem` out: rio clip DEM part.tif "
            "--bounds 'WEST SOUTH EAST NORTH'"
        )


def _range(name: str, maps: Maps) -> tuple[float, float]:
    """The least and the greatest value, of what is averaged too."""
    low, high = (maps.get(f"{name} {end}", maps[name]) for end in ("min", "max"))
    least, most = (
        np.fmin.reduce(low, None, initial=np.inf),
        np.fmax.reduce(high, None, initial=-np.inf),
    )
    return float(least), float(most)


def provenance(name: str) -> dict[str, str | None]:
    """The name of a raster and, of a file, its SHA-256; of an address without what may
    be secret.
    """
    path = Path(name)
    if path.is_file():
        return {"file": path.name, "sha256": digest_of_path(path)}
    return {"file": re.sub("//[^/@]*@", "//", name).partition("?")[0], "sha256": None}
