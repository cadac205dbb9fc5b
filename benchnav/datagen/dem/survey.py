"""Reading of rasters, map by map.

Elevation at the resolution of the maps is read without resampling. If the raster's
cells are at most half as wide as the maps' cells, elevation is averaged, since
otherwise small bumps would alias into slopes. In all other cases, elevation is
interpolated by cubic convolution. Colours and traversability are averaged; a cell gets
the class that covers most of the cell. Letters in shapes: B maps, K bands, H×W cells of
a map.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from benchnav.core.errors import DatasetError, expect
from benchnav.core.sources import digest_of_path
from benchnav.datagen.dem.drive_cells import (
    BANDS,
    DrivenCells,
    aggregate_drives,
    check_drive_count,
    describe_drives,
    elevation_under,
    to_map_crs,
)
from benchnav.datagen.dem.drive_log import DriveLog, Drives, read_drives
from benchnav.datagen.dem.drive_motion import compare_motion, compare_slopes
from benchnav.datagen.dem.extent import Extent, Layout
from benchnav.datagen.dem.options import Cut, Rasters
from benchnav.datagen.dem.raster import Layer, Raster, open_raster
from benchnav.datagen.dem.recipe_fit import check_fit
from benchnav.datagen.dem.tiling import SLACK, Run, Shape
from benchnav.datagen.dem.units import check_metres, in_unit
from benchnav.datagen.dem.value_checks import (
    check_elevation,
    check_layer,
    check_limits,
)
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import FIELDS, OPTIONAL, Field, Maps

# Tangent of 80°. Natural terrain next to cells of height 0 is less steep.
_CLIFF = 5.67
_SHOWN_CLASSES = 10
# Rasters other than the elevation model: argument, dtypes of the bands, and resampling.
_FURTHER_RASTERS = (
    ("classes", (), "mode"),
    ("photo", ("uint8",) * 3, "average"),
    ("traversability", (), "average"),
)


class Survey:
    """Rasters resampled to the cells of all maps.

    Attributes:
        tiling: tiling of the terrain into maps.
        layers: resampled rasters by argument; `NAME min` and `NAME max` are the minimum
            and maximum of the raster's values in each averaged cell.
        unlabelled: whether no cell has a class.
        driven: values of driven cells; None without a log of drives.
        arguments: names of the user's arguments; `layer NAME` for a layer.
        fields: stored fields of layers, by name.
        layers_with_value: names of layers with at least one value so far.
        is_inside: two masks, of the rows and of the columns that lie completely on the
            elevation model, padded by one cell.
        indices: class index by raster value; NaN for values without a label.
        cliff_m: difference in height between neighbouring cells that natural terrain
            does not exceed, in metres.
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
            stack: context that closes the rasters.
            dem: raster of elevations, one band, by any name that rasterio opens.
            rasters: rasters other than the elevation model.
            recipe: recipe with the size and resolution of the maps and the class table.
            cut: selection of maps in the terrain.
            drives: log of drives, around which maps are cut. If None, maps are cut from
                the whole elevation model.
            announce: receives a description of the import, in sentences.

        Raises:
            ConfigError: If a setting does not fit the recipe.
            DatasetError: If a raster or the log does not fit, or the terrain is too
                small.
        """
        step = recipe.resolution_m
        class_names = _class_names(rasters, recipe)
        log = read_drives(drives) if drives else None
        dem_raster = stack.enter_context(open_raster("dem", dem))
        dem_raster, unit = in_unit(dem_raster, cut.ground.dem_unit)
        crs, bounds, cell_m = dem_raster.georeference()
        stride = _stride(cut, recipe)
        positions_m = None
        if log is not None:
            log = compare_motion(to_map_crs(log, dem_raster, crs, bounds))
            check_drive_count(log, list(cut.shares))
            positions_m = log.positions_m
        extent = Extent(
            raster=dem_raster,
            unit=unit,
            crs=crs,
            bounds=bounds,
            cell_m=np.array(cell_m),
            shares=cut.shares,
            origin_m=cut.ground.origin,
            positions_m=positions_m,
        )
        layout = extent.lay(recipe.grid, stride)
        self.tiling = layout.tiling
        self.fields = {layer.name: layer.field for layer in rasters.layers}
        drive_fields: dict[str, Field] = {}
        if log is not None:
            drive_fields = {name: OPTIONAL[name] for name in BANDS if name in OPTIONAL}
        fields = FIELDS | drive_fields | self.fields
        announce(extent.describe(layout, recipe, fields))
        check_fit(extent, layout, recipe, cut.ground)

        south_m, west_m = (extent.corner_m + layout.offset_m).tolist()
        height, width = self.tiling.cells
        area = (west_m, south_m, west_m + width * step, south_m + height * step)
        sources = [(dem_raster, layout.resampling)]
        for raster, resampling in _open_further_rasters(stack, rasters):
            extent.suggest_origin(raster, layout, step, announce)
            if raster.argument.startswith("layer "):
                _check_covers(raster, crs, area, step)
            sources.append((raster, resampling))
        frame = extent.frame(layout, step)
        self.layers: dict[str, Layer] = {}
        for raster, resampling in sources:
            for name, layer in _resampled_layers(raster, frame, resampling):
                self.layers[name] = layer
                stack.enter_context(layer.warped)
        self.arguments = [raster.argument for raster, _ in sources]
        origins: dict[str, Any] = {
            raster.argument: provenance(raster.name) for raster, _ in sources
        }
        if rasters.classes:
            names_by_value = sorted(class_names.items())
            ids = {str(value): name for value, name in names_by_value}
            origins["classes"]["ids"] = ids
        self.source: dict[str, Any] = {
            "kind": "dem",
            **origins["dem"],
            "crs": crs.to_string(),
            "resolution_m": list(reversed(cell_m)),
            "origin_m": [west_m, south_m],
            "tiles": list(self.tiling.tiles),
            "stride_m": [cells * step for cells in reversed(self.tiling.stride)],
        }
        for argument, _, _ in _FURTHER_RASTERS:
            self.source[argument] = origins.get(argument)
        if dem_raster.metres != 1:
            self.source["metres_per_unit"] = dem_raster.metres
        if self.fields:
            layer_origins = {name: origins[f"layer {name}"] for name in self.fields}
            self.source["layers"] = layer_origins
        self.layers_with_value: set[str] = set()
        self.is_inside = _inside_masks(extent, layout, step)
        indices: dict[str | None, float] = {None: np.nan}
        for index, item in enumerate(recipe.classes):
            indices[item.name] = index
        self.indices = {value: indices[name] for value, name in class_names.items()}
        self.unlabelled = rasters.unlabelled
        self.cliff_m = _CLIFF * max(*cell_m, step)
        self.driven: DrivenCells | None = None
        if log is not None:
            self._add_drives(log, layout, step)

    def _add_drives(self, log: DriveLog, layout: Layout, step: float) -> None:
        """Add the driven cells of a log, and the log's manifest entry."""
        positions = (log.positions_m - layout.offset_m) / step
        row, column = (positions - 0.5).T
        elevation_m = elevation_under(self.layers["dem"], row, column)
        log = compare_slopes(log, elevation_m)
        cell_row, cell_column = np.floor(positions).astype(np.int64).T
        log, self.driven = aggregate_drives(log, self.tiling, cell_row, cell_column)
        entry = describe_drives(log, list(self.tiling.strips))
        self.source["drives"] = entry
        self.source["traversability"] = {
            name: entry[name] for name in ("file", "sha256")
        }

    def read(self, run: Run) -> tuple[ndarray, Maps]:
        """Return the raster values of the maps of a run.

        Returns:
            Elevation in metres, padded by one cell of the surrounding terrain, shape
            [B, H + 2, W + 2]; and values by the names in `arguments` and `BANDS`, each
            of shape [B, K, H, W]. Missing values are NaN.

        Raises:
            DatasetError: If a raster cannot be read, or contains invalid values.
        """
        north, east = self.tiling.stride
        height, width = self.tiling.shape
        south = run.row * north
        wests = [column * east for column in run.columns]
        strip_rows = range(south, south + height)
        strip_columns = range(wests[0], wests[-1] + width)
        padded = Maps()  # values of each map and of one cell around it
        for name, layer in self.layers.items():
            strip = layer.read(strip_rows, strip_columns)
            padded[name] = _cut_maps(strip, wests, width + 2)
        dem = self.layers["dem"].raster
        is_row_inside, is_column_inside = self.is_inside
        is_outside_row = ~is_row_inside[south:][: height + 2]
        for index, west in enumerate(wests):
            values = {name: maps[index] for name, maps in padded.items()}
            check_elevation(dem, values, self.cliff_m)
            is_outside_column = ~is_column_inside[west:][: width + 2]
            values["dem"][:, is_outside_row] = np.nan
            values["dem"][:, :, is_outside_column] = np.nan
        if "traversability" in padded:
            check_limits(self.layers["traversability"].raster, padded, 0, 1)
        for name, field in self.fields.items():
            raster = self.layers[f"layer {name}"].raster
            if check_layer(raster, padded, field):
                self.layers_with_value.add(name)
        inputs = {name: padded[name][:, :, 1:-1, 1:-1] for name in self.arguments}
        if "classes" in inputs:
            inputs["classes"] = self._classes(inputs["classes"])
        elif self.unlabelled:
            inputs["classes"] = np.full_like(inputs["dem"], np.nan)
        if self.driven:
            strip = self.driven.read(strip_rows, strip_columns)
            maps = _cut_maps(strip, wests, width)
            for band, name in enumerate(BANDS):
                inputs[name] = maps[:, band : band + 1]
        return padded["dem"][:, 0], inputs

    def _classes(self, values: ndarray) -> ndarray:
        """Return the class indices of raster values; NaN for values without a label.

        Raises:
            DatasetError: If a value has no class.
        """
        indices = np.full_like(values, np.nan)
        for value, index in self.indices.items():
            indices[values == value] = index
        present = values[~np.isnan(values)]
        unnamed = np.setdiff1d(present, list(self.indices))
        if len(unnamed):
            name = self.layers["classes"].raster.name
            shown = [f"{value:g}" for value in unnamed[:_SHOWN_CLASSES]]
            if len(unnamed) > _SHOWN_CLASSES:
                shown.append("…")
            raise DatasetError(
                f"Expected only the values {sorted(self.indices)} in `classes`, got "
                f"also [{', '.join(shown)}] in {name}. Map each value to a class with "
                "`class_ids`, or to null if it has no label. If a value marks missing "
                f"cells, declare it: rio edit-info --nodata VALUE {name}"
            )
        return indices


def _class_names(rasters: Rasters, recipe: Recipe) -> dict[int, str | None]:
    """Return checked class names by raster value; None for values without a label."""
    names = [item.name for item in recipe.classes]
    class_ids = rasters.class_ids
    if class_ids is None:
        return dict(enumerate(names))
    unknown = sorted(map(str, {*class_ids.values()} - {*names, None}))
    expect(
        not unknown,
        f"`class_ids` to name classes of the recipe, among {names}, got {unknown}.",
    )
    return class_ids


def _stride(cut: Cut, recipe: Recipe) -> Shape:
    """Return the checked number of cells from one map to the next, in y and x."""
    if cut.stride_m is None:
        return recipe.grid.shape
    n_cells = cut.stride_m / recipe.resolution_m
    expect(
        n_cells > 0.5 and abs(n_cells - round(n_cells)) < 1e-6,
        f"`stride` to be a multiple of {recipe.resolution_m:g} m (the resolution of "
        f"the maps), got {cut.stride_m:g} m.",
    )
    return round(n_cells), round(n_cells)


def _open_further_rasters(
    stack: ExitStack, rasters: Rasters
) -> Iterator[tuple[Raster, str]]:
    """Open the rasters other than the elevation model; yield (raster, resampling)."""
    for argument, kinds, resampling in _FURTHER_RASTERS:
        name = getattr(rasters, argument)
        if name:
            yield stack.enter_context(open_raster(argument, name, kinds)), resampling
    for layer in rasters.layers:
        raster = stack.enter_context(open_raster(f"layer {layer.name}", layer.raster))
        if layer.field.unit == "m":
            check_metres(raster)
        yield raster, layer.resampling


def _resampled_layers(
    raster: Raster, frame: Mapping[str, Any], resampling: str
) -> Iterator[tuple[str, Layer]]:
    """Yield (name, layer) of a raster's values, and of extremes of averaged cells."""
    is_photo = raster.argument == "photo"
    bands = [1, 2, 3] if is_photo else [1]
    yield raster.argument, raster.resampled(frame, bands, resampling)
    if resampling in ("average", "cubic") and not is_photo:
        for end in ("min", "max"):
            yield f"{raster.argument} {end}", raster.resampled(frame, bands, end)


def _inside_masks(extent: Extent, layout: Layout, step: float) -> list[ndarray]:
    """Return masks of rows and columns inside the elevation model, padded by one."""
    slack = SLACK * step
    masks = []
    sides = zip(layout.offset_m, layout.tiling.cells, extent.size_m, strict=True)
    for offset, count, size in sides:
        edges = offset + step * np.arange(-1, count + 2)
        masks.append((edges[:-1] > -slack) & (edges[1:] < size + slack))
    return masks


def _cut_maps(strip: ndarray, wests: Sequence[int], width: int) -> ndarray:
    """Return the maps of a strip, shape [B, K, H, W].

    Args:
        strip: values of neighbouring maps, shape [K, H, columns].
        wests: first column of each map, ascending; the strip begins at `wests[0]`.
        width: number of columns of a map.
    """
    offsets = [west - wests[0] for west in wests]
    return np.stack([strip[:, :, offset : offset + width] for offset in offsets])


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
        DatasetError: If the raster does not cover all maps.
    """
    with raster.warped(crs) as warped:
        bounds = warped.bounds
        slack = max(step, *warped.res)
    uncovered_m = np.subtract(bounds, area) * (1, 1, -1, -1)
    if (uncovered_m > slack).any():
        expected = " ".join(f"{value:.10g}" for value in area)
        covered = " ".join(f"{value:.10g}" for value in bounds)
        raise DatasetError(
            f"Expected `{raster.argument}` to cover all of the terrain (WEST SOUTH "
            f"EAST NORTH {expected} in {crs.to_string()[:80]}), got {raster.name}, "
            f"which covers {covered}. Use a raster that covers the terrain and "
            "declares a value for missing cells. Or reduce `dem` to the part that the "
            "raster covers: rio clip DEM part.tif --bounds 'WEST SOUTH EAST NORTH'"
        )


def provenance(name: str) -> dict[str, str | None]:
    """Return the name of a raster, and its SHA-256 digest if it is a file.

    Credentials and queries are removed from URLs, since they may be secret.
    """
    path = Path(name)
    if path.is_file():
        return {"file": path.name, "sha256": digest_of_path(path)}
    without_user = re.sub("//[^/@]*@", "//", name)
    address = without_user.partition("?")[0]
    return {"file": address, "sha256": None}
