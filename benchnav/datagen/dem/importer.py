"""Real ground: a GeoTIFF elevation model, resampled and cut into maps of the dataset schema.

The maps lie side by side from the raster's south-west corner and are numbered row by row, northward,
each row eastward. A GeoTIFF's rows run southward; ours run northward, with y. Slope and λ follow from
the real elevation; classes and colour too come from rasters, or from the recipe where none are given.

A cell that a missing one has a share in is missing. Where the maps are finer than the raster,
elevation is interpolated by cubic convolution, since the creases of bilinear facets would show in the
slopes. Where they are coarser it is averaged over each cell, so that bumps too small for the maps do
not fold into slopes of theirs.

Letters in shapes: B maps, K layers of numbers, H×W cells of a map, h×w cells of a raster.
"""

import hashlib
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from benchnav.datagen.dem.raster import SLACK, Raster, crs_name, load_rasterio, opened
from benchnav.datagen.dem.resample import Rule, heights, shares, snapped
from benchnav.datagen.files.create import join
from benchnav.datagen.files.folder import Contents
from benchnav.datagen.files.writer import check_target, named_errors, pack
from benchnav.datagen.recipe.recipe import Recipe, Split
from benchnav.datagen.schema import FIELDS, quantise
from benchnav.datagen.synth.generate import Maps, class_map, complete, reference_time_s
from benchnav.errors import ConfigError, DatasetError
from benchnav.files import sole_writer

_VALUES_AT_ONCE = 2**21
_MAPS_AT_ONCE = 32
_CACHE_MB = 128  # of raster that GDAL keeps; what it would choose grows with the machine
_MOST_RELIEF_M = 2048.0  # float32 holds the schema's steps of 2^-13 m up to here


def import_dem(
    dem: Path,
    out: Path,
    recipe: Recipe,
    *,
    dataset_id: str,
    split: str = "test/real",
    scenario: str = "std",
    classes: Path | None = None,
    class_ids: dict[int, str] | None = None,
    photo: Path | None = None,
    solvable: bool = False,
    overwrite: bool = False,
) -> Iterator[tuple[int, int]]:
    """Makes a dataset of one split from rasters, yielding (maps done, maps in all); to be iterated to the end.

    Maps with missing cells are left out. A map's random numbers go by its number in the raster, so they
    are the same whichever others are left out.

    Args:
        dem: GeoTIFF of elevations in metres: one band, north up, in a projected CRS in metres.
        out: file to write.
        recipe: size, resolution, start and goal of the maps, class table, light, seed.
        dataset_id: name and version of the dataset.
        split: name of its only split.
        scenario: which of the recipe's scenarios lights the maps.
        classes: GeoTIFF of terrain classes in the CRS of `dem`, covering it; a cell takes the class that
            covers most of it, and the maps are of one environment, 0. None: the recipe lays classes out.
        class_ids: class names by value of `classes`. None: values are indices into the class table.
        photo: GeoTIFF of red, green and blue, uint8, in the CRS of `dem`, covering it; averaged over
            each cell. None: the classes are painted.
        solvable: keep only maps whose goal can be reached, and store the grid reference time.
        overwrite: replace a file that is there.

    Raises:
        ConfigError: rasterio is not installed, or a setting does not fit the recipe.
        DatasetError: a raster is not as said above, no map is left, or `out` exists or cannot be written.
    """
    check_target(out, overwrite)
    only = Split(scenario=scenario, maps=1, solvable=solvable)
    recipe = replace(recipe, id=dataset_id, splits={split: only})
    if class_ids is not None and classes is None:
        raise ConfigError("Expected `classes` with `class_ids`, got none. Pass the raster they belong to.")
    with ExitStack() as stack:
        stack.enter_context(load_rasterio().Env(GDAL_CACHEMAX=_CACHE_MB))
        ground = stack.enter_context(opened("dem", dem))
        cut = _cut(ground, recipe)
        layers = {"elevation_m": _ground_layer(ground, cut)}
        if classes:
            table = stack.enter_context(opened("classes", classes, ground))
            layers["class_id"] = _class_layer(table, cut, recipe, class_ids)
        if photo:
            layers["rgb"] = _photo_layer(stack.enter_context(opened("photo", photo, ground)), cut)

        stack.enter_context(named_errors(out))
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent))
        made = []
        for first in range(0, cut.maps, _MAPS_AT_ONCE):
            numbers = np.arange(first, min(first + _MAPS_AT_ONCE, cut.maps))
            made.append(_make(recipe, split, cut, layers, numbers, Path(folder) / f"{first}.h5"))
            yield first + len(numbers), cut.maps
        source = _source(cut, layers, made)
        count = len(source["kept"])
        recipe = replace(recipe, splits={split: replace(only, maps=count)})
        parts = [{"maps": count, "source": source}]
        splits = {split: {"scenario": scenario, "maps": count, "parts": parts}}
        files = {split: [some.path for some in made if len(some.numbers)]}
        with sole_writer(out, str(out)):
            check_target(out, overwrite)
            join(out, Contents(id=dataset_id, recipes=[recipe], splits=splits, files=files))


@dataclass(frozen=True)
class _Cut:
    """Rows and columns of maps of a shape (H, W), from a south-west corner on."""

    west_m: float
    south_m: float
    rows: int
    columns: int
    shape: tuple[int, int]
    resolution_m: float

    @property
    def maps(self) -> int:
        """Number of maps."""
        return self.rows * self.columns

    def weights(self, raster: Raster, rule: Rule) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        """Weights by a rule of a raster's rows and columns in the cells of all maps, northward and eastward."""
        (height, width), (cell_x, cell_y), bounds = raster.file.shape, raster.cell_m, raster.file.bounds
        y = self.resolution_m * np.arange(self.rows * self.shape[0] + 1)
        x = self.resolution_m * np.arange(self.columns * self.shape[1] + 1)
        down = snapped(snapped((bounds.top - self.south_m) / cell_y) - y / cell_y).clip(0, height)
        across = snapped(snapped((self.west_m - bounds.left) / cell_x) + x / cell_x).clip(0, width)
        return rule(down[1:], down[:-1], height), rule(across[:-1], across[1:], width)


@dataclass(frozen=True)
class _Layer:
    """What the maps take from a raster: weighted sums of numbers that its values stand for.

    Args:
        raster: where from.
        bands: which of its bands.
        down: weights of its rows in each row of the maps' cells, northward, sparse, shape [rows·H, h].
        across: weights of its columns, sparse, shape [columns·W, w].
        numbers: from values [bands, h, w] and which are missing [h, w] to numbers [K, h, w].
        settle: from sums [K, H, W] to what the map holds.
        names: class names by value, where it is a raster of classes.
    """

    raster: Raster
    bands: list[int]
    down: sparse.csr_matrix
    across: sparse.csr_matrix
    numbers: Callable[[np.ndarray, np.ndarray], np.ndarray]
    settle: Callable[[np.ndarray], np.ndarray]
    names: dict[str, str] = field(default_factory=dict)

    def resample(self, cut: _Cut, number: int) -> np.ndarray | None:
        """Gives one map, or None where a cell of it is missing."""
        (height, width), (row, column) = cut.shape, divmod(number, cut.columns)
        down = self.down[row * height : (row + 1) * height]
        across = self.across[column * width : (column + 1) * width]
        columns = slice(across.indices.min(), across.indices.max() + 1)
        across, last = across[:, columns], down.indices.max() + 1
        sums: Any = 0.0
        # Some rows of the raster at a time: a map of coarse cells may cover much of it.
        step = max(1, _VALUES_AT_ONCE // (columns.stop - columns.start))
        for first in range(down.indices.min(), last, step):
            rows = slice(first, min(first + step, last))
            values, missing = self.raster.read(self.bands, rows, columns)
            part = down[:, rows]
            if missing.any() and (abs(part) @ missing.astype(np.float64) @ abs(across).T).any():
                return None
            sums = sums + np.stack([part @ layer @ across.T for layer in self.numbers(values, missing)])
        return self.settle(sums)


@dataclass(frozen=True)
class _Made:
    """What came of some maps: a file of those kept, their numbers and lowest elevations, and a count."""

    path: Path
    numbers: np.ndarray
    lowest_m: np.ndarray
    not_solvable: int


def _make(
    recipe: Recipe, split: str, cut: _Cut, layers: dict[str, _Layer], numbers: np.ndarray, path: Path
) -> _Made:
    taken: dict[int, Maps] = {}
    for number in numbers.tolist():
        found: Maps = {}
        for name, layer in layers.items():
            values = layer.resample(cut, number)
            if values is None:
                break
            found[name] = values
        else:
            taken[number] = found
    if not taken:
        return _Made(path, numbers[:0], np.empty(0), 0)
    numbers = np.array(list(taken))
    given = {name: np.stack([found[name] for found in taken.values()]) for name in layers}
    lowest_m = given["elevation_m"].min(axis=(1, 2))
    class_id = given["class_id"] if "class_id" in given else class_map(recipe, split, numbers)
    height_m = given["elevation_m"] - lowest_m[:, None, None]
    spec = recipe.splits[split]
    maps = complete(recipe, recipe.scenarios[spec.scenario], split, numbers, class_id, height_m)
    if "class_id" in given:
        maps["environment"] = np.zeros(len(numbers))
    if "rgb" in given:
        maps["rgb"] = given["rgb"]
    maps["reference_time_s"] = np.full(len(numbers), np.nan)
    kept = np.ones(len(numbers), dtype=bool)
    if spec.solvable:
        maps["reference_time_s"] = reference_time_s(recipe, maps)
        kept = np.isfinite(maps["reference_time_s"])
    if kept.any():
        entry = {"scenario": spec.scenario, "maps": int(kept.sum()), "parts": []}
        stored = {name: maps[name][kept].astype(FIELDS[name].dtype) for name in FIELDS}
        path.write_bytes(pack(recipe.id, recipe, split, entry, stored))
    return _Made(path, numbers[kept], lowest_m[kept], int((~kept).sum()))


def _source(cut: _Cut, layers: dict[str, _Layer], made: list[_Made]) -> dict[str, Any]:
    """Says in the manifest where the maps came from.

    Raises:
        DatasetError: there are none.
    """
    kept = [number for block in made for number in block.numbers.tolist()]
    not_solvable = sum(block.not_solvable for block in made)
    missing = cut.maps - len(kept) - not_solvable
    ground = layers["elevation_m"].raster
    if not kept:
        raise DatasetError(
            f"Expected `dem` to give at least one map, got none from {ground.path}: of {cut.maps}, {missing} "
            f"have missing cells and {not_solvable} a goal that cannot be reached. Fill the gaps, or take a "
            "recipe of smaller maps."
        )

    def provenance(name: str) -> dict[str, Any]:
        path = layers[name].raster.path
        with open(path, "rb") as file:
            return {"file": path.name, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}

    classes = None
    if "class_id" in layers:
        classes = {**provenance("class_id"), "ids": layers["class_id"].names}
    return {
        "kind": "dem",
        **provenance("elevation_m"),
        "crs": crs_name(ground.file.crs),
        "resolution_m": list(ground.cell_m),
        "origin_m": [cut.west_m, cut.south_m],
        "tiles": [cut.rows, cut.columns],
        "kept": kept,
        "lowest_m": [level for block in made for level in block.lowest_m.tolist()],
        "classes": classes,
        "photo": provenance("rgb") if "rgb" in layers else None,
        "left_out": {"missing_cells": missing, "not_solvable": not_solvable},
    }


def _ground_layer(ground: Raster, cut: _Cut) -> _Layer:
    file, path = ground.file, ground.path
    if file.count != 1:
        raise DatasetError(
            f"Expected one band in `dem`, got {file.count} in {path}. "
            f"Take one out: rio stack --bidx 1 {path} one-band.tif"
        )
    if (file.units[0] or "m").lower() not in ("m", "metre", "meter", "metres", "meters"):
        raise DatasetError(
            f"Expected elevations of `dem` in metres, got {file.units[0]!r} in {path}. Convert them (gdal_calc.py, "
            f"× 0.3048 for feet), then declare the unit: rio edit-info --bidx 1 --units metre {path}"
        )

    def checked(height_m: np.ndarray) -> np.ndarray:
        low, high = height_m.min(initial=np.inf), height_m.max(initial=-np.inf)
        if high - low > _MOST_RELIEF_M:
            odd = low if low < -1000 else high
            raise DatasetError(
                f"Expected elevations of `dem` within {_MOST_RELIEF_M:g} m on a map, got {low:g} to {high:g} in "
                f"{path}. If {odd:.9g} stands for missing, declare it: rio edit-info --nodata {odd:.9g} {path}"
            )
        return height_m

    def metres(values: np.ndarray, missing: np.ndarray) -> np.ndarray:
        height_m = values.astype(np.float64) * file.scales[0] + file.offsets[0]
        checked(height_m[0][~missing])
        return np.where(missing, 0, height_m)

    def settled(sums: np.ndarray) -> np.ndarray:
        # Rounded far below the stored steps, so that halves of those round alike on every machine.
        return checked(quantise(sums[0], 30))

    return _Layer(ground, [1], *cut.weights(ground, heights), metres, settled)


def _class_layer(table: Raster, cut: _Cut, recipe: Recipe, class_ids: dict[int, str] | None) -> _Layer:
    if table.file.count != 1:
        raise DatasetError(f"Expected one band in `classes`, got {table.file.count} in {table.path}.")
    names = [kind.name for kind in recipe.classes]
    named = dict(enumerate(names)) if class_ids is None else class_ids
    unknown = sorted(set(named.values()) - set(names))
    if unknown:
        raise ConfigError(f"Expected `class_ids` to name classes of the recipe, {names}, got {unknown}.")
    found: set[Any] = set()
    height, width = table.file.shape
    step = max(1, _VALUES_AT_ONCE // width)
    for first in range(0, height, step):
        cells, missing = table.read([1], slice(first, min(first + step, height)), slice(0, width))
        found.update(np.unique(cells[0][~missing]).tolist())
    strange = sorted(found - set(named))
    if strange:
        raise DatasetError(
            f"Expected values of `classes` in {sorted(named)}, got {_few(strange)} too in {table.path}. "
            f"Name each by `class_ids`, from {names}; or, if one stands for missing, declare it: "
            f"rio edit-info --nodata VALUE {table.path}"
        )
    values = np.array(sorted(found) or [0])
    ids = np.array([names.index(named[value]) for value in values.tolist() if value in named] or [0])
    shown = np.unique(ids)

    def members(cells: np.ndarray, missing: np.ndarray) -> np.ndarray:
        places = np.searchsorted(values, np.where(missing, values[0], cells[0]))
        return (ids[places] == shown[:, None, None]) & ~missing

    def largest(shares: np.ndarray) -> np.ndarray:
        # Rounded, so that of two equal shares the lower index wins on every machine.
        return shown[np.round(shares, 9).argmax(axis=0)]

    by_value = {str(int(value)): named[value] for value in sorted(found)}
    return _Layer(table, [1], *cut.weights(table, shares), members, largest, by_value)


def _few(values: list[Any]) -> str:
    return f"[{', '.join(map(str, values[:10]))}{', …' if len(values) > 10 else ''}]"


def _photo_layer(photo: Raster, cut: _Cut) -> _Layer:
    kinds = photo.file.dtypes
    if len(kinds) < 3 or set(kinds[:3]) != {"uint8"}:
        raise DatasetError(
            f"Expected `photo` with bands red, green and blue as uint8, got {', '.join(kinds)} in {photo.path}. "
            "Convert it: gdal_translate -expand rgb for a palette, rio convert --dtype uint8 --scale-ratio RATIO "
            "for deeper numbers."
        )

    def colours(values: np.ndarray, missing: np.ndarray) -> np.ndarray:
        return np.where(missing, 0, values.astype(np.float64))

    return _Layer(photo, [1, 2, 3], *cut.weights(photo, shares), colours, np.rint)


def _cut(ground: Raster, recipe: Recipe) -> _Cut:
    bounds, (width_m, height_m) = ground.file.bounds, recipe.grid.extent_m
    wide, high = bounds.right - bounds.left, bounds.top - bounds.bottom
    slack = SLACK * recipe.resolution_m
    rows, columns = int((high + slack) // height_m), int((wide + slack) // width_m)
    if rows == 0 or columns == 0:
        raise DatasetError(
            f"Expected `dem` to hold at least one map of {width_m:g} m × {height_m:g} m, got {ground.path} of "
            f"{wide:g} m × {high:g} m. Take a larger raster or a recipe of smaller maps."
        )
    return _Cut(bounds.left, bounds.bottom, rows, columns, recipe.grid.shape, recipe.resolution_m)
