"""Check whether a recipe's maps fit an elevation model, or suggest settings that do.

There must not be too many maps, and their cells must not be much smaller than those of
the elevation model. Otherwise, the error contains a resolution, size or stride that
fits.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from benchnav.core.copula import LONGEST_CORRELATION
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.grid import Grid
from benchnav.datagen.dem.extent import Extent, Layout
from benchnav.datagen.dem.options import GroundOptions
from benchnav.datagen.dem.tiling import Run, Shape
from benchnav.datagen.layers.spec import overrides_of
from benchnav.datagen.recipe.recipe import Recipe

# Limit of the ratio of the raster's cell width to the maps' cell width. At larger
# ratios, maps show interpolation instead of terrain.
MAX_RATIO = 3.0
# Maximum relief of a map, up to which float32 represents the schema's steps of 2^-13 m.
MAX_RELIEF_M = 2048.0
_DIVISORS = (1, 2, 4)  # suggested divisors of the number of cells along a map's side
_MIN_SIDE = 8  # minimum suggested number of cells along a map's side

# Changed fields of a recipe, and the divisor of the number of cells along a map's side.
Scaling = tuple[dict[str, Any], int]


class GroundError(ConfigError):
    """Error on terrain that yields too many or too smooth maps.

    Args:
        problem: Problem as text, with the option that allows such maps.
        changes: Recipe settings that solve the problem, as new values by key; may be
            empty.
        stride_m: Changed distance from one map to the next in metres; None if it need
            not change.
    """

    def __init__(
        self, problem: str, changes: Mapping[str, Any], stride_m: float | None
    ) -> None:
        """Store the arguments, from which callers can compose a command."""
        self.problem = problem
        self.changes = changes
        self.stride_m = stride_m
        words = self.settings
        if stride_m is not None:
            words.append(f"stride_m={stride_m:.10g}")
        super().__init__(self.advise(" ".join(words)) if words else problem)

    @property
    def settings(self) -> list[str]:
        """The changes as arguments of a command, `key=value`."""
        return [f"{key}={_yaml(value)}" for key, value in self.changes.items()]

    def advise(self, remedy: str) -> str:
        """Return the problem followed by settings or a command that solve it."""
        return f"{self.problem} Or fit the maps to the raster: {remedy}"


def check_fit(
    extent: Extent, layout: Layout, recipe: Recipe, options: GroundOptions
) -> None:
    """Reject terrain that yields too many or too smooth maps.

    Args:
        extent: Terrain.
        layout: Layout of the maps on the terrain.
        recipe: Recipe of the maps.
        options: Maximum number of maps, and whether the elevation model may be much
            coarser than the maps.

    Raises:
        GroundError: If the terrain yields such maps. The error contains settings that
            avoid this.
    """
    step = recipe.resolution_m
    cell_m = float(max(extent.cell_m))
    max_maps = options.max_maps
    n_maps = layout.tiling.maps
    name = extent.raster.name
    is_coarse = cell_m / step >= MAX_RATIO * (1 - 1e-9) and not options.coarse
    if is_coarse:
        problem = (
            f"Expected cells of `dem` less than {MAX_RATIO:g} times as wide as the "
            f"maps' cells of {step:g} m, got {cell_m:.4g} m in {name}. The "
            f"terrain of all {n_maps:,} maps would be too smooth. Pass --coarse to "
            "allow such cells."
        )
    elif n_maps > max_maps:
        problem = (
            f"Expected at most {max_maps:,} maps, got {n_maps:,} on {name}. Pass "
            f"--max-maps {n_maps} to allow them."
        )
    else:
        return
    scalings: Iterator[Scaling] = iter([({}, 1)])
    if is_coarse:
        scalings = _scalings(recipe, cell_m)
    corrections = _corrections(extent, layout, recipe, scalings, max_maps)
    changes, stride_m = next(corrections, ({}, None))
    raise GroundError(problem, changes, stride_m)


def _corrections(
    extent: Extent,
    layout: Layout,
    recipe: Recipe,
    scalings: Iterator[Scaling],
    max_maps: int,
) -> Iterator[tuple[dict[str, Any], float | None]]:
    """Yield recipe settings and a stride in metres with which maps fit.

    There is one pair for each scaling with which maps fit, in the given order. The
    stride is None if maps are adjacent, which is the default.

    Args:
        extent: Terrain.
        layout: Layout of the recipe's maps on the terrain.
        recipe: Recipe of the maps.
        scalings: Changes of the recipe to try, in order.
        max_maps: Maximum number of maps.
    """
    north, east = layout.tiling.stride
    is_adjacent = (north, east) == recipe.grid.shape
    for changes, divisor in scalings:
        stride = (max(1, north // divisor), max(1, east // divisor))
        try:
            changed = replace(recipe, **changes)
            thinned, factor = _thinned(extent, changed.grid, stride, max_maps)
            if not _has_maps(extent, thinned, changed.resolution_m):
                continue
        except BenchnavError:
            continue
        stride_m = None
        if factor > 1 or not is_adjacent:
            stride_m = stride[1] * factor * changed.resolution_m
        yield _file_settings(changes, recipe), stride_m


def _thinned(
    extent: Extent, grid: Grid, stride: Shape, max_maps: int
) -> tuple[Layout, int]:
    """Return a layout of up to `max_maps` maps, and the factor of its stride.

    The factor is relative to the given stride; it is 1 if the stride is unchanged.
    """
    factor = 1
    layout = extent.lay(grid, stride)
    while layout.tiling.maps > max_maps:
        excess = layout.tiling.maps / max_maps
        factor += max(1, int(np.sqrt(excess)) - 1)
        layout = extent.lay(grid, (stride[0] * factor, stride[1] * factor))
    return layout, factor


def _has_maps(extent: Extent, layout: Layout, step: float) -> bool:
    """Return whether each split has a map that an import would keep.

    Such a map has no missing elevations, and at most the maximum relief.
    """
    frame = extent.frame(layout, step)
    layer = extent.raster.resampled(frame, [1], layout.resampling)
    without_map = set(extent.shares)
    with layer.warped:
        for run in layout.tiling.runs(1):
            if run.split in without_map:
                rows, columns = _cells_of(run, layout)
                heights_m = layer.read(rows, columns)
                relief_m = np.ptp(heights_m[:, 1:-1, 1:-1])
                if relief_m <= MAX_RELIEF_M:  # false for NaN
                    without_map.remove(run.split)
            if not without_map:
                return True
    return False


def _cells_of(run: Run, layout: Layout) -> tuple[range, range]:
    """Return rows and columns of the cells of a run's first map."""
    height, width = layout.tiling.shape
    south = run.row * layout.tiling.stride[0]
    west = run.columns[0] * layout.tiling.stride[1]
    return range(south, south + height), range(west, west + width)


def _scalings(recipe: Recipe, cell_m: float) -> Iterator[Scaling]:
    """Yield scalings of a recipe to a raster's cell width or half of it.

    Scalings with more cells per map come first.
    """
    for divisor in _DIVISORS:
        for width_m in (cell_m, cell_m / 2):
            step = float(f"{width_m:.3g}")
            yield _scaled(recipe, step, divisor), divisor


def _scaled(recipe: Recipe, step: float, divisor: int) -> dict[str, Any]:
    """Return changed fields of a recipe for another resolution and map size.

    Lengths are scaled with the map.

    Args:
        recipe: Recipe of the maps.
        step: New width of a cell in metres.
        divisor: Divisor of the number of cells along a map's side.
    """
    factor = step / recipe.resolution_m / divisor

    def scaled(value: float) -> float:
        return float(f"{value * factor:.6g}")

    changes: dict[str, Any] = {"resolution_m": step}
    if divisor > 1:
        for name in ("height", "width"):
            side = getattr(recipe, name) // divisor
            changes[name] = max(_MIN_SIDE, side)
    if recipe.places is not None:
        places = recipe.places
        least_m = scaled(places.least_distance_m)
        margin_m = scaled(places.margin_m)
        changes["places"] = replace(places, least_distance_m=least_m, margin_m=margin_m)
    for name in ("start_m", "goal_m"):
        position = getattr(recipe, name)
        if position is not None:
            changes[name] = tuple(scaled(value) for value in position)
    periods_m = [scaled(value) for value in recipe.class_periods_m]
    changes["class_periods_m"] = tuple(max(step, value) for value in periods_m)
    changes["layers"] = tuple(spec.scaled(factor, step) for spec in recipe.layers)
    extent_m = step * min(recipe.height // divisor, recipe.width // divisor)
    if recipe.correlation_m > LONGEST_CORRELATION * extent_m:
        correlation_m = 0.9 * LONGEST_CORRELATION * extent_m
        changes["correlation_m"] = float(f"{correlation_m:.3g}")
    return changes


def _file_settings(changes: Mapping[str, Any], recipe: Recipe) -> dict[str, Any]:
    """Return changed fields of a recipe under the keys of a recipe file."""
    plain = dict(changes)
    layers = plain.pop("layers", recipe.layers)
    places = plain.pop("places", None)
    for name, value in plain.items():
        if isinstance(value, tuple):
            plain[name] = list(value)
    plain |= overrides_of(recipe.layers, layers)
    if places:
        plain |= {f"places.{name}": value for name, value in vars(places).items()}
    return plain


def _yaml(value: Any) -> str:
    """Return a number, or a list of numbers, as YAML."""
    if isinstance(value, list):
        return f"[{','.join(map(_yaml, value))}]"
    return f"{value:.10g}"
