"""Layout of maps on an elevation model, described and checked before values are read.

The first map lies at the south-west corner of the elevation model, of the terrain
around the drives, or at the origin that the user sets. Unless they are named (x, y),
positions are (y, x) in metres from the south-west corner of the elevation model, shape
[2].
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from benchnav.core.errors import ConfigError, DatasetError, expect
from benchnav.core.grid import Grid
from benchnav.datagen.dem.crs import load_rasterio
from benchnav.datagen.dem.raster import Raster
from benchnav.datagen.dem.tiling import (
    SLACK,
    Shape,
    Tiling,
    cut,
    cut_around,
    fewest_cells,
)
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import Fields

_KERNEL_CELLS = 2.0  # half width of the kernel of cubic convolution, in cells
# Description of each resampling of elevation.
_RESAMPLED = {
    "nearest": "not resampled",
    "average": "averaged",
    "cubic": "interpolated",
}


class Layout(NamedTuple):
    """Layout of maps on an elevation model.

    Args:
        tiling: Tiling of the terrain into maps.
        offset_m: South-west corner of the first map.
        resampling: Resampling of elevation, in GDAL's terms.
    """

    tiling: Tiling
    offset_m: ndarray
    resampling: str


@dataclass(frozen=True, kw_only=True)
class Extent:
    """Terrain on which maps can lie.

    Args:
        raster: The elevation model.
        unit: Unit of elevation, and the unit's source, as text.
        crs: CRS of the maps, in metres.
        bounds: Bounds of the elevation model in `crs`.
        cell_m: Size of the elevation model's cells in `crs`, northward and eastward.
        shares: Fraction of the maps of each split.
        origin_m: (x, y) of the south-west corner of the first map in `crs`; None for
            the default.
        positions_m: Positions of drives, around which maps are cut, shape [N, 2]; None for
            all of the elevation model.
    """

    raster: Raster
    unit: str
    crs: Any
    bounds: Any
    cell_m: ndarray
    shares: Mapping[str, float]
    origin_m: tuple[float, float] | None = None
    positions_m: ndarray | None = None

    @property
    def corner_m(self) -> ndarray:
        """(y, x) of the elevation model's south-west corner in `crs`, shape [2]."""
        return np.array([self.bounds.bottom, self.bounds.left])

    @property
    def size_m(self) -> ndarray:
        """Size of the elevation model in metres, northward and eastward, shape [2]."""
        return np.array([self.bounds.top, self.bounds.right]) - self.corner_m

    def lay(self, grid: Grid, stride: Shape) -> Layout:
        """Return the layout of maps on the terrain.

        Args:
            grid: Size and resolution of a map.
            stride: Cells from one map to the next, northward and eastward.

        Raises:
            ConfigError: If the origin lies off the elevation model, or so far
                north-east that not each split gets a map.
            DatasetError: If the terrain is too small.
        """
        step = grid.resolution_m
        start_m = np.zeros(2)
        end_m = self.size_m
        if self.positions_m is not None:
            map_m = np.multiply(grid.shape, step)
            stride_m = np.multiply(stride, step)
            start_m, size_m = cut_around(
                self.positions_m, self.size_m, self.cell_m, map_m, stride_m
            )
            end_m = start_m + size_m
        if self.origin_m is not None:
            start_m = np.array(self.origin_m[::-1]) - self.corner_m
            self._check_origin(start_m, step)
            self._check_room(start_m, end_m, grid, stride)
        resampling, reach_m = self._resample(step, start_m)
        size_m = end_m - start_m
        cells = _cells_within(size_m, step)
        if np.less(cells, grid.shape).any():
            width_m, height_m = grid.extent_m
            raise DatasetError(
                f"Expected `dem` to cover at least one map of {width_m:g} m × "
                f"{height_m:g} m, got {self.raster.name} of {self.size_m[1]:g} m × "
                f"{self.size_m[0]:g} m. Use a larger raster or a recipe with smaller "
                "maps."
            )
        tiling = cut(cells, grid.shape, stride, self.shares)
        # Margins keep the maps off the raster's edges, where interpolation lacks
        # neighbours.
        max_margin_m = 0.0 if self.origin_m is not None else reach_m
        margin_m = (size_m - np.multiply(step, tiling.cells)) / 2
        offset_m = start_m + np.clip(margin_m, 0, max_margin_m)
        return Layout(tiling, offset_m, resampling)

    def _check_origin(self, start_m: ndarray, step: float) -> None:
        """Reject an origin off the elevation model."""
        west, south, east, north = (f"{value:.10g}" for value in self.bounds)
        is_on = (start_m >= -SLACK * step) & (start_m < self.size_m)
        expect(
            is_on.all(),
            f"`origin` on `dem` (x {west} to {east} and y {south} to {north} in "
            f"{_name_of(self.crs)}), got {list(self.origin_m or ())}.",
        )

    def _check_room(
        self, start_m: ndarray, end_m: ndarray, grid: Grid, stride: Shape
    ) -> None:
        """Reject an origin too far north-east for a map of each split.

        The origin is only rejected if another origin has room for these maps.

        Args:
            start_m: Origin.
            end_m: North-east corner of the terrain.
            grid: Size and resolution of a map.
            stride: Cells from one map to the next, northward and eastward.

        Raises:
            ConfigError: If the origin is rejected, with the largest origin that fits.
        """
        if self._has_room(start_m, end_m, grid, stride):
            return
        largest_m = self._largest_origin(start_m, end_m, grid, stride)
        if largest_m is None:
            return
        width_m, height_m = grid.extent_m
        maps = f"maps of {len(self.shares)} splits"
        if len(self.shares) == 1:
            maps = "a map"
        end = "of the terrain around the drives"
        if self.positions_m is None:
            end = "of `dem`"
        raise ConfigError(
            f"Expected `origin` from which {maps} of {width_m:g} m × {height_m:g} m "
            f"fit up to the north-east corner {end}, got {list(self.origin_m or ())}. "
            "The largest that fits: "
            f"--origin '{_origin_text(self.corner_m + largest_m)}'"
        )

    def _largest_origin(
        self, start_m: ndarray, end_m: ndarray, grid: Grid, stride: Shape
    ) -> ndarray | None:
        """Return the largest origin with room for a map of each split, or None."""
        for cells in fewest_cells(grid.shape, stride, len(self.shares)):
            last_m = end_m - np.multiply(cells, grid.resolution_m)
            for corner_m in (np.minimum(start_m, last_m), last_m):
                is_on = (corner_m >= -SLACK * grid.resolution_m).all()
                if is_on and self._has_room(corner_m, end_m, grid, stride):
                    return corner_m
        return None

    def _has_room(
        self, start_m: ndarray, end_m: ndarray, grid: Grid, stride: Shape
    ) -> bool:
        """Return whether a map of each split fits between two corners."""
        cells = _cells_within(end_m - start_m, grid.resolution_m)
        if np.less(cells, grid.shape).any():
            return False
        try:
            cut(cells, grid.shape, stride, self.shares)
        except DatasetError:
            return False
        return True

    def _resample(self, step: float, start_m: ndarray) -> tuple[str, float]:
        """Return the resampling of elevation, and its kernel's half width in metres."""
        offset = start_m / self.cell_m
        is_aligned = np.abs(offset - np.rint(offset)).max() < SLACK
        is_same_width = np.allclose(self.cell_m, step, rtol=1e-9)
        is_same_crs = self.bounds == self.raster.file.bounds
        if is_aligned and is_same_width and is_same_crs:
            return "nearest", 0.0
        if max(self.cell_m) <= step / 2 * (1 + 1e-9):
            return "average", 0.0
        return "cubic", _KERNEL_CELLS * max(*self.cell_m, step)

    def describe(self, layout: Layout, recipe: Recipe, fields: Fields) -> str:
        """Return a description of cells, unit, maps and their size in bytes.

        Args:
            layout: Layout of the maps.
            recipe: Recipe of the maps.
            fields: Stored fields of each map.
        """
        grid = recipe.grid
        tiling = layout.tiling
        file = self.raster.file
        bytes_per_map = 0
        for field in fields.values():
            n_values = int(np.prod(field.entry_shape(*grid.shape)))
            bytes_per_map += np.dtype(field.dtype).itemsize * n_values
        n_bytes = tiling.maps * bytes_per_map
        gigabytes = f"{n_bytes / 1e9:,.2f}" if n_bytes >= 1e7 else "under 0.01"
        cell_height, cell_width = (f"{value:.4g}" for value in self.cell_m)
        maps = f"{tiling.maps:,} map{'s' * (tiling.maps > 1)}"
        stride_m = tiling.stride[1] * grid.resolution_m
        corner = _origin_text(self.corner_m + layout.offset_m)
        origin_hint = "set by `origin`" if self.origin_m else "set it by `origin`"
        return (
            f"{self.raster.name}: {file.height} × {file.width} cells of {cell_width} m "
            f"× {cell_height} m on the terrain, elevations in {self.unit}, "
            f"{_RESAMPLED[layout.resampling]}. {maps} of {grid.height} × "
            f"{grid.width} cells of {grid.resolution_m:g} m, one every {stride_m:g} m "
            f"from the south-west corner {corner} ({origin_hint}), in "
            f"{_name_of(self.crs)}; {gigabytes} GB before compression."
        )

    def frame(self, layout: Layout, step: float) -> dict[str, Any]:
        """Return the cells of all maps, padded by one cell, for `Raster.resampled`.

        Args:
            layout: Layout of the maps.
            step: Width of a cell in metres.
        """
        south_m, west_m = (self.corner_m + layout.offset_m).tolist()
        height, width = layout.tiling.cells
        north_m = south_m + (height + 1) * step
        transform = load_rasterio().transform.from_origin(
            west_m - step, north_m, step, step
        )
        return {
            "crs": self.crs,
            "transform": transform,
            "height": height + 2,
            "width": width + 2,
        }

    def suggest_origin(
        self,
        raster: Raster,
        layout: Layout,
        step: float,
        announce: Callable[[str], object],
    ) -> None:
        """Suggest another raster's corner as the origin if it lies within a map.

        Args:
            raster: A raster other than the elevation model.
            layout: Layout of the maps.
            step: Width of a map's cell in metres.
            announce: Receives the suggestion, a sentence.
        """
        with raster.warped(self.crs) as warped:
            bounds = warped.bounds
        has_default_origin = self.origin_m is None and self.positions_m is None
        if not has_default_origin or bounds != raster.file.bounds:
            return
        start_m = np.array([bounds.bottom, bounds.left]) - self.corner_m
        is_on = ((start_m >= 0) & (start_m < self.size_m)).all()
        stride_m = np.multiply(layout.tiling.stride, step)
        n_strides = (start_m - layout.offset_m) / stride_m
        if is_on and np.abs(n_strides - np.rint(n_strides)).max() > SLACK:
            corner = _origin_text((bounds.bottom, bounds.left))
            announce(
                f"`{raster.argument}` begins within a map. To begin the maps at its "
                f"corner, pass --origin '{corner}'"
            )


def _name_of(crs: Any) -> str:
    """Return the code or definition of a CRS; if it is long, the name of the CRS."""
    text = crs.to_string()
    if len(text) < 60:
        return text
    projjson = crs.to_dict(projjson=True)
    name = projjson.get("source_crs", projjson).get("name", "unknown")
    return "a CRS without a name" if name == "unknown" else str(name)


def _cells_within(size_m: ndarray, step: float) -> list[int]:
    """Return how many cells of width `step` fit into a size, in y and x."""
    return np.floor(size_m / step + SLACK).astype(int).tolist()


def _origin_text(corner_m: Iterable[float]) -> str:
    """Return (y, x) in metres as text for the option `origin`, to a micrometre."""
    y, x = (f"{value:.6f}".rstrip("0").rstrip(".") for value in corner_m)
    return f"[{x},{y}]"
