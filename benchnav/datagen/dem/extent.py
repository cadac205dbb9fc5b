"""Layout of maps on an elevation model, described and checked before it is read.

The maps start at the south-west corner of the elevation model, around the drives, or at
the origin that the user sets. Pairs of metres are northward and eastward, shape [2],
from the south-west corner of the elevation model, unless they are named (x, y).
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from benchnav.core.copula import LONGEST_CORRELATION
from benchnav.core.errors import BenchnavError, ConfigError, DatasetError, expect
from benchnav.core.grid import Grid
from benchnav.datagen.dem.raster import GroundOptions, Raster, load_rasterio
from benchnav.datagen.dem.tiling import (
    SLACK,
    Shape,
    Tiling,
    cut,
    cut_around,
    fewest_cells,
)
from benchnav.datagen.layers.spec import overrides_of
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import Fields

# Width of a raster's cell over that of a map's. Beyond it, maps show interpolation
# rather than terrain.
MAX_RATIO = 3.0
# Of a map: up to here, float32 represents the schema's steps of 2^-13 m.
MAX_RELIEF_M = 2048.0
_KERNEL_CELLS = 2.0  # half width of cubic convolution
_MIN_SIDE = 8  # minimum cells of a map's side in a suggested correction


class GroundError(ConfigError):
    """Error of terrain that gives too many or too smooth maps.

    Args:
        problem: The problem in a sentence, with the option that allows it.
        changes: Recipe settings by key that correct it; empty if only `stride_m` or
            nothing does.
        stride_m: Distance from one map to the next, if it must change too; else None.
    """

    def __init__(
        self, problem: str, changes: Mapping[str, Any], stride_m: float | None
    ) -> None:
        """Keep the parts, from which a command can be put together."""
        self.problem, self.changes, self.stride_m = problem, changes, stride_m
        words = (
            self.settings
            if stride_m is None
            else [*self.settings, f"stride_m={stride_m:.10g}"]
        )
        super().__init__(self.advise(" ".join(words)) if words else problem)

    @property
    def settings(self) -> list[str]:
        """The changes as words of a command."""
        return [f"{key}={_text(value)}" for key, value in self.changes.items()]

    def advise(self, remedy: str) -> str:
        """Return the problem with settings or a command that correct it."""
        return f"{self.problem} Or fit the maps to the raster: {remedy}"


class Laid(NamedTuple):
    """Maps laid on an elevation model.

    Args:
        tiling: Tiling of the terrain into maps.
        offset_m: South-west corner of the first map.
        how: Resampling of elevation, in GDAL's terms.
    """

    tiling: Tiling
    offset_m: ndarray
    how: str


@dataclass(frozen=True, kw_only=True)
class Extent:
    """Terrain on which maps can lie.

    Args:
        raster: The elevation model.
        unit: Its unit of elevation, and the unit's source, as text.
        crs: CRS of the maps, in metres.
        bounds: Bounds of the elevation model in `crs`.
        cell_m: Size of its cells in `crs`.
        shares: Fraction of the maps of each split.
        origin_m: (x, y) of the south-west corner of the first map in `crs`; None for
            the default.
        places_m: Positions of drives, around which maps are cut, shape [N, 2]; None for
            all of the elevation model.
    """

    raster: Raster
    unit: str
    crs: Any
    bounds: Any
    cell_m: ndarray
    shares: Mapping[str, float]
    origin_m: tuple[float, float] | None = None
    places_m: ndarray | None = None

    @property
    def corner_m(self) -> ndarray:
        """(y, x) of the elevation model's south-west corner in `crs`, shape [2]."""
        return np.array([self.bounds.bottom, self.bounds.left])

    @property
    def size_m(self) -> ndarray:
        """Size of the elevation model, shape [2]."""
        return np.array([self.bounds.top, self.bounds.right]) - self.corner_m

    def lay(self, grid: Grid, stride: Shape) -> Laid:
        """Lay maps on the ground.

        Args:
            grid: Size and resolution of a map.
            stride: Cells from one map to the next, northward and eastward.

        Raises:
            ConfigError: If the origin lies off the elevation model, or too far
                north-east on it.
            DatasetError: If the ground is too small.
        """
        step = grid.resolution_m
        start_m, end_m = np.zeros(2), self.size_m
        if self.places_m is not None:
            map_m, apart_m = np.multiply(grid.shape, step), np.multiply(stride, step)
            start_m, end_m = cut_around(
                self.places_m, self.size_m, self.cell_m, map_m, apart_m
            )
            end_m = start_m + end_m
        if self.origin_m is not None:
            start_m = np.array(self.origin_m[::-1]) - self.corner_m
            west, south, east, north = (f"{value:.10g}" for value in self.bounds)
            expect(
                ((start_m >= -SLACK * step) & (start_m < self.size_m)).all(),
                f"`origin` on `dem`, x {west} to {east} and y {south} to {north} in "
                f"{_name_of(self.crs)}, "
                f"got {list(self.origin_m)}.",
            )
            self._check_room(start_m, end_m, grid, stride)
        how, reach_m = self._resample(step, start_m)
        size_m = end_m - start_m
        cells = _whole_cells(size_m, step)
        if np.less(cells, grid.shape).any():
            wide, high = grid.extent_m
            raise DatasetError(
                f"Expected `dem` to hold at least one map of {wide:g} m × {high:g} m, "
                f"got {self.raster.name} of "
                f"{self.size_m[1]:g} m × {self.size_m[0]:g} m. Take a larger raster "
                "or a recipe of smaller maps."
            )
        tiling = cut(cells, grid.shape, stride, self.shares)
        # What would be left over keeps the maps off the raster's edges, where
        # interpolation lacks neighbours.
        reach_m *= self.origin_m is None
        return Laid(
            tiling,
            start_m
            + np.clip((size_m - np.multiply(step, tiling.cells)) / 2, 0, reach_m),
            how,
        )

    def _check_room(
        self, start_m: ndarray, end_m: ndarray, grid: Grid, stride: Shape
    ) -> None:
        """Reject an origin too far north-east for a map of each split, where another
        one leaves room for them.

        Args:
            start_m: The origin.
            end_m: North-east corner of the ground.
            grid: Size and resolution of a map.
            stride: Cells from one map to the next.

        Raises:
            ConfigError: If it is, with the largest origin that fits.
        """
        step, n_splits = grid.resolution_m, len(self.shares)

        def fits(corner_m: ndarray) -> bool:
            cells = _whole_cells(end_m - corner_m, step)
            try:
                return not np.less(cells, grid.shape).any() and bool(
                    cut(cells, grid.shape, stride, self.shares)
                )
            except DatasetError:
                return False

        if fits(start_m):
            return
        for cells in fewest_cells(grid.shape, stride, n_splits):
            last_m = end_m - np.multiply(cells, step)
            for corner_m in (np.minimum(start_m, last_m), last_m):
                if (corner_m >= -SLACK * step).all() and fits(corner_m):
                    wide, high = grid.extent_m
                    maps = "a map" if n_splits == 1 else f"maps of {n_splits} splits"
                    end = (
                        "of `dem`"
                        if self.places_m is None
                        else "of the ground around the drives"
                    )
                    raise ConfigError(
                        f"Expected `origin` from which {maps} of {wide:g} m × "
                        f"{high:g} m fit up to the "
                        f"north-east corner {end}, got {list(self.origin_m or ())}. "
                        "The largest that fits: "
                        f"--origin '{_origin(self.corner_m + corner_m)}'"
                    )

    def _resample(self, step: float, start_m: ndarray) -> tuple[str, float]:
        """Return the resampling of elevation on cells of a width, and its reach."""
        offset = start_m / self.cell_m
        is_same = (
            np.allclose(self.cell_m, step, rtol=1e-9)
            and self.bounds == self.raster.file.bounds
        )
        if is_same and np.abs(offset - np.rint(offset)).max() < SLACK:
            return "nearest", 0.0
        if max(self.cell_m) <= step / 2 * (1 + 1e-9):
            return "average", 0.0
        return "cubic", _KERNEL_CELLS * max(*self.cell_m, step)

    def describe(self, laid: Laid, recipe: Recipe, fields: Fields) -> str:
        """Return a paragraph on the cells, the maps, their size in bytes, and the unit.

        Args:
            laid: The maps.
            recipe: Of the maps.
            fields: What is stored of each.
        """
        grid, tiling, file = recipe.grid, laid.tiling, self.raster.file
        n_bytes = tiling.maps * sum(
            np.dtype(field.dtype).itemsize
            * int(np.prod(field.entry_shape(*grid.shape)))
            for field in fields.values()
        )
        high, wide = (f"{value:.4g}" for value in self.cell_m)
        taken = {
            "nearest": "taken as they are",
            "average": "averaged",
            "cubic": "interpolated",
        }[laid.how]
        gigabytes = f"{n_bytes / 1e9:,.2f}" if n_bytes >= 1e7 else "under 0.01"
        maps = f"{tiling.maps:,} map{'s' * (tiling.maps > 1)}"
        origin_hint = "set by `origin`" if self.origin_m else "set it by `origin`"
        return (
            f"{self.raster.name}: {file.height} × {file.width} cells of {wide} m × "
            f"{high} m on the ground, elevations "
            f"in {self.unit}, {taken}. {maps} of {grid.height} × {grid.width} cells "
            "of "
            f"{grid.resolution_m:g} m, one every "
            f"{tiling.stride[1] * grid.resolution_m:g} m from the south-west corner "
            f"{_origin(self.corner_m + laid.offset_m)} on ({origin_hint}), in "
            f"{_name_of(self.crs)}; {gigabytes} GB before "
            "compression."
        )

    def frame(self, laid: Laid, step: float) -> dict[str, Any]:
        """Return the cells of all maps, padded by one, as an argument of `Raster.laid`.

        Args:
            laid: The maps.
            step: Width of a cell, metres.
        """
        south_m, west_m = (self.corner_m + laid.offset_m).tolist()
        height, width = laid.tiling.cells
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

    def _has_maps(self, laid: Laid, step: float) -> bool:
        """Return whether each split has a map without missing elevation."""
        layer, without_map = (
            self.raster.laid(self.frame(laid, step), [1], laid.how),
            set(self.shares),
        )
        (north, east), (height, width) = laid.tiling.stride, laid.tiling.shape
        with layer.warped:
            for run in laid.tiling.runs(1):
                if run.split in without_map:
                    south, west = run.row * north, run.columns[0] * east
                    heights_m = layer.read(
                        range(south, south + height), range(west, west + width)
                    )
                    if np.ptp(heights_m[:, 1:-1, 1:-1]) <= MAX_RELIEF_M:  # NaN is not
                        without_map.remove(run.split)
                if not without_map:
                    return True
        return False

    def suggest_origin(
        self, raster: Raster, laid: Laid, step: float, announce: Callable[[str], object]
    ) -> None:
        """Announce the corner of another raster as an origin, if it lies within a map.

        Args:
            raster: Not the elevation model.
            laid: The maps.
            step: Width of a map's cell, metres.
            announce: Is given a sentence.
        """
        with raster.warped(self.crs) as warped:
            bounds = warped.bounds
        if (
            self.origin_m is not None
            or self.places_m is not None
            or bounds != raster.file.bounds
        ):
            return
        start_m = np.array([bounds.bottom, bounds.left]) - self.corner_m
        is_on = ((start_m >= 0) & (start_m < self.size_m)).all()
        maps = (start_m - laid.offset_m) / np.multiply(laid.tiling.stride, step)
        if is_on and np.abs(maps - np.rint(maps)).max() > SLACK:
            announce(
                f"`{raster.argument}` begins within a map. To begin the maps where it "
                "does, pass "
                f"--origin '{_origin((bounds.bottom, bounds.left))}'"
            )

    def check(self, laid: Laid, recipe: Recipe, options: GroundOptions) -> None:
        """Reject ground that makes too many or too smooth maps.

        Args:
            laid: The maps.
            recipe: Of the maps.
            options: Most maps, and whether the elevation model may be much coarser than
                they are.

        Raises:
            GroundError: If it does, with settings that do not.
        """
        max_maps = options.max_maps
        step, count, name = recipe.resolution_m, laid.tiling.maps, self.raster.name
        ratio = float(max(self.cell_m)) / step
        is_coarse = ratio >= MAX_RATIO * (1 - 1e-9) and not options.coarse
        if not is_coarse and count <= max_maps:
            return
        problem = (
            f"Expected cells of `dem` less than {MAX_RATIO:g} times as wide as the "
            f"maps' {step:g} m, got "
            f"{max(self.cell_m):.4g} m in {name}, which {count:,} maps would show as "
            "smooth ground. Pass --coarse to "
            "allow it."
            if is_coarse
            else f"Expected at most {max_maps:,} maps, got {count:,} on {name}. Pass "
            f"--max-maps {count} to allow them."
        )
        raise GroundError(
            problem,
            *next(self._corrections(laid, recipe, max_maps, is_coarse), ({}, None)),
        )

    def _corrections(
        self, laid: Laid, recipe: Recipe, max_maps: int, is_coarse: bool
    ) -> Iterator[tuple[dict[str, Any], float | None]]:
        """Yield recipe settings and a stride that fit, nearest to the user's first."""
        cell_m = float(max(self.cell_m))
        for divisor in (1, 2, 4) if is_coarse else (1,):
            for step in (cell_m, cell_m / 2) if is_coarse else (recipe.resolution_m,):
                changes = (
                    _scaled(recipe, float(f"{step:.3g}"), divisor) if is_coarse else {}
                )
                try:
                    changed = replace(recipe, **changes)
                    stride = tuple(
                        max(1, cells // divisor) for cells in laid.tiling.stride
                    )
                    fit, times = self.lay(changed.grid, stride), 1  # type: ignore[arg-type]
                    while fit.tiling.maps > max_maps:
                        times += max(1, int(np.sqrt(fit.tiling.maps / max_maps)) - 1)
                        fit = self.lay(
                            changed.grid, (stride[0] * times, stride[1] * times)
                        )
                    if not self._has_maps(fit, changed.resolution_m):
                        continue
                except BenchnavError:
                    continue
                is_default = (
                    times == 1 and np.equal(laid.tiling.stride, recipe.grid.shape).all()
                )
                yield (
                    _plain(changes, recipe),
                    None if is_default else stride[1] * times * changed.resolution_m,
                )


def _scaled(recipe: Recipe, step: float, divisor: int) -> dict[str, Any]:
    """Return fields of a recipe for another resolution, scaled with the map.

    Args:
        recipe: Of the maps.
        step: Width of a cell, metres.
        divisor: Of the cells of a map's side.
    """
    times = step / recipe.resolution_m / divisor
    changes: dict[str, Any] = {"resolution_m": step}
    if divisor > 1:
        changes |= {
            name: max(_MIN_SIDE, getattr(recipe, name) // divisor)
            for name in ("height", "width")
        }

    def scaled(value: float) -> float:
        return float(f"{value * times:.6g}")

    if recipe.places is not None:
        places = recipe.places
        least_m, margin_m = scaled(places.least_distance_m), scaled(places.margin_m)
        changes["places"] = replace(places, least_distance_m=least_m, margin_m=margin_m)
    for name in ("start_m", "goal_m"):
        if (position := getattr(recipe, name)) is not None:
            changes[name] = tuple(scaled(value) for value in position)
    changes["class_periods_m"] = tuple(
        max(step, scaled(value)) for value in recipe.class_periods_m
    )
    changes["layers"] = tuple(spec.scaled(times, step) for spec in recipe.layers)
    extent_m = step * min(recipe.height // divisor, recipe.width // divisor)
    if recipe.correlation_m > LONGEST_CORRELATION * extent_m:
        changes["correlation_m"] = float(f"{0.9 * LONGEST_CORRELATION * extent_m:.3g}")
    return changes


def _plain(changes: Mapping[str, Any], recipe: Recipe) -> dict[str, Any]:
    """Return changed fields of a recipe as its file has them."""
    plain = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in changes.items()
    }
    plain |= overrides_of(recipe.layers, plain.pop("layers", recipe.layers))
    if places := plain.pop("places", None):
        plain |= {f"places.{name}": value for name, value in vars(places).items()}
    return plain


def _name_of(crs: Any) -> str:
    """Return the code of a CRS; if it has no code, its name."""
    text = crs.to_string()
    if len(text) < 60:
        return text
    projjson = crs.to_dict(projjson=True)
    name = projjson.get("source_crs", projjson).get("name", "unknown")
    return "a CRS without a name" if name == "unknown" else str(name)


def _whole_cells(size_m: ndarray, step: float) -> list[int]:
    """Return how many cells of a width fit into a size."""
    return np.floor(size_m / step + SLACK).astype(int).tolist()


def _origin(corner_m: Iterable[float]) -> str:
    """Return (y, x) in metres as `origin` takes it, to a micrometre."""
    y, x = (f"{value:.6f}".rstrip("0").rstrip(".") for value in corner_m)
    return f"[{x},{y}]"


def _text(value: Any) -> str:
    """Return a number, or a list of numbers, as YAML."""
    return (
        f"[{','.join(map(_text, value))}]"
        if isinstance(value, list)
        else f"{value:.10g}"
    )
