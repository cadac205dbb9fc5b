"""Import of real data: rasters become maps of the dataset schema.

Slopes are computed from the real elevation. For slopes at a map's edges, the elevation
around the map is read too. The recipe provides what the rasters do not contain. The
true distribution of λ in real terrain is unknown, and the dataset records this;
`Terrain.truth` is then the distribution of the recipe's class table.

Overlapping maps contain the same cells. Each of them is stored with the number of its
`group`, the statistical unit. Maps of one group overlap, directly or through other
maps; maps of different groups do not overlap. If all maps of a split overlap in this
sense, the split is one group and one unit. To divide it into smaller groups, maps
between the groups would have to be omitted. This would yield no more units than
adjacent maps without overlap.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from benchnav.core.errors import DatasetError, expect
from benchnav.core.store import building, resolve_link
from benchnav.datagen.dem.crs import load_rasterio
from benchnav.datagen.dem.drive_log import Drives
from benchnav.datagen.dem.options import Cut, Rasters
from benchnav.datagen.dem.recipe_fit import MAX_RELIEF_M
from benchnav.datagen.dem.survey import Survey
from benchnav.datagen.dem.tiling import Run
from benchnav.datagen.files.create import SHARD_CELLS
from benchnav.datagen.files.hdf5 import (
    Contents,
    ShardFile,
    assemble,
    exclusive_output,
    pack,
)
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import Recipe, Split
from benchnav.datagen.schema import (
    FIELDS,
    OPTIONAL,
    UNLABELLED,
    Fields,
    Maps,
    join_maps,
    quantise,
)
from benchnav.datagen.synth.generate import class_map, complete, reference_time_s

_CELLS_AT_ONCE = 2**20
# Size of GDAL's cache of rasters. The default size grows with the machine's memory.
_CACHE_BYTES = 2**29

# Reasons why maps are left out, in the order of the checks.
REASONS = {
    "not_driven": "have no cell that a drive of their split crossed",
    "missing_elevation": "have cells without elevation",
    "too_rough": f"span more than {MAX_RELIEF_M:g} m of elevation",
    "missing_classes": (
        "have no cell with a class or measured λ, or have cells with neither class nor "
        "photo"
    ),
    "missing_colours": "have cells without colour",
    "not_solvable": "have a goal that cannot be reached",
}
# Records of each map: index in the terrain, lowest elevation in metres, and number of
# unlabelled cells.
_RECORDS = ("kept", "lowest_m", "unlabelled")
# Input without which a map is left out, by the reason that is recorded for this.
_REQUIRED = {
    "not_driven": "drive_count",
    "missing_elevation": "dem",
    "missing_classes": "classes",
    "missing_colours": "photo",
}


def import_dem(
    dem: str,
    out: Path,
    recipe: Recipe,
    rasters: Rasters = Rasters(),  # noqa: B008
    *,
    drives: Drives | None = None,
    cut: Cut = Cut(),  # noqa: B008
    overwrite: bool = False,
    announce: Callable[[str], object] = str,
) -> Iterator[tuple[int, int]]:
    """Create a dataset from rasters; yield (maps done, total maps).

    Iterate to the end. Maps are left out if elevation or colour is missing in some
    cells. Classes, measured λ and values of layers may be missing in some cells. A
    map's random numbers depend only on the map's index in the terrain.

    Args:
        dem: raster of elevations, by any name that rasterio opens.
        out: path of the file to write, if its suffix is `.h5` or `.hdf5`; else path of
            the folder to write.
        recipe: recipe with the id of the dataset, the maps' size, resolution, start and
            goal, the class table, the light and the seed.
        rasters: rasters of classes, colours, λ and layers.
        drives: log of drives, the source of λ. The maps are cut around its positions;
            maps without a driven cell are left out.
        cut: selection of maps in the terrain.
        overwrite: whether to replace an existing dataset.
        announce: receives a description of the import before maps are read.

    Raises:
        ConfigError: If rasterio is not installed, a setting does not fit the recipe, or
            `out` exists.
        DatasetError: If a raster does not fit, a split gets no map, or `out` cannot be
            written.
    """
    expect(
        drives is None or not rasters.traversability,
        "either `drives` or `traversability` as the source of λ, got both. Leave one "
        "out.",
    )
    expect(
        not (cut.solvable and rasters.unlabelled),
        "`classes` with `solvable`, got none. Whether a map is solvable depends on the "
        "classes of its cells. Leave `solvable` out, or pass --classes.",
    )
    affecting = [spec.name for spec in recipe.layers if spec.affects]
    expect(
        not affecting,
        f"a recipe whose `layers` do not change λ, got {', '.join(affecting)}. An "
        "import draws no layers. Leave these layers out of the recipe.",
    )
    out = resolve_link(out)
    splits = {
        name: Split(scenario=cut.scenario, maps=1, solvable=cut.solvable)
        for name in cut.shares
    }
    recipe = replace(recipe, splits=splits)
    with ExitStack() as stack:
        stack.enter_context(exclusive_output(out, overwrite))
        stack.enter_context(load_rasterio().Env(GDAL_CACHEMAX=_CACHE_BYTES))
        survey = Survey(stack, dem, rasters, recipe, cut, drives, announce)
        folder = stack.enter_context(building(out))
        writers = {name: _SplitWriter(name, recipe, folder, survey) for name in splits}
        done = 0
        for run in survey.tiling.runs(recipe.grid.maps_in(_CELLS_AT_ONCE)):
            writers[run.split].add(run)
            done += len(run.columns)
            yield done, survey.tiling.maps
        _check_layers(survey)
        sizes = {}
        entries = {}
        files = {}
        for name, writer in writers.items():
            writer.finish()
            sizes[name] = replace(splits[name], maps=len(writer.records["kept"]))
            entries[name] = writer.entry()
            files[name] = [folder / shard.name for shard in writer.shards]
        contents = Contents(
            id=recipe.id,
            recipes=[replace(recipe, splits=sizes)],
            splits=entries,
            files=files,
            fields=_fields_of(survey),
        )
        assemble(contents, folder, out)


def _check_layers(survey: Survey) -> None:
    """Check that each layer has a value in at least one cell of the maps."""
    for name in set(survey.fields) - survey.layers_with_value:
        raster = survey.layers[f"layer {name}"].raster.name
        raise DatasetError(
            f"Expected a value of `layer {name}` in at least one cell of the maps, got "
            f"only missing values in {raster}. Pass a raster with values there."
        )


def _fields_of(survey: Survey) -> Fields:
    """Return the stored fields of the maps, by name."""
    names = []
    if survey.tiling.overlaps:
        names.append("group")
    if survey.driven is not None:
        names += ["drive_count", "drive_std"]
    optional = {name: OPTIONAL[name] for name in OPTIONAL if name in names}
    return FIELDS | optional | survey.fields


@dataclass
class _SplitWriter:
    """Writer of one split's maps; it records stored maps and counts omitted ones."""

    name: str
    recipe: Recipe
    folder: Path
    survey: Survey
    records: dict[str, list[Any]] = field(
        default_factory=lambda: {name: [] for name in _RECORDS}
    )
    left_out: Counter[str] = field(default_factory=Counter)
    shards: list[ShardFile] = field(default_factory=list)
    pending: list[Maps] = field(default_factory=list)

    def add(self, run: Run) -> None:
        """Add the valid maps of a run, count invalid ones, and write full shards."""
        padded_m, inputs = self.survey.read(run)
        is_valid = self._count_invalid(padded_m, inputs)
        if not is_valid.any():
            return
        first = run.row * self.survey.tiling.tiles[1]
        indices = first + np.array(run.columns)
        valid_inputs = {name: values[is_valid] for name, values in inputs.items()}
        maps = self._maps_of(indices[is_valid], padded_m[is_valid], valid_inputs)
        is_solved = ~np.isinf(maps["reference_time_s"])
        self.left_out["not_solvable"] += int((~is_solved).sum())
        names = [name for name in _fields_of(self.survey) if name != "group"]
        names += [f"record {name}" for name in _RECORDS]
        self.pending.append({name: maps[name][is_solved] for name in names})
        n_cells = sum(maps["class_id"].size for maps in self.pending)
        if n_cells >= SHARD_CELLS:
            self._flush()

    def _count_invalid(self, padded_m: ndarray, inputs: Maps) -> ndarray:
        """Return a mask of valid maps, bool, shape [B]; count the others by reason."""
        is_valid = np.ones(len(padded_m), dtype=bool)
        missing_masks = _missing_masks(inputs)
        for reason, name in _REQUIRED.items():
            if name in missing_masks:
                is_missing = missing_masks[name]
                self.left_out[reason] += int((is_valid & is_missing).sum())
                is_valid &= ~is_missing
        relief_m = np.ptp(padded_m[:, 1:-1, 1:-1], axis=(1, 2))
        is_rough = is_valid & (relief_m > MAX_RELIEF_M)
        if is_rough.any():
            self.left_out["too_rough"] += int(is_rough.sum())
        return is_valid & ~is_rough

    def _maps_of(self, indices: ndarray, padded_m: ndarray, inputs: Maps) -> Maps:
        """Return the stored fields and the records of maps.

        Args:
            indices: indices of the maps in the terrain, shape [B].
            padded_m: elevation in metres, padded by one cell, shape [B, H + 2, W + 2].
            inputs: inputs from `Survey.read` by name, each of shape [B, K, H, W].
        """
        recipe = self.recipe
        padded_m = quantise(padded_m, 13)
        lowest_m = padded_m[:, 1:-1, 1:-1].min(axis=(1, 2))
        height_m = padded_m - lowest_m[:, None, None]
        class_id = class_map(recipe, self.name, indices)
        if "classes" in inputs:
            class_id = np.nan_to_num(inputs["classes"][:, 0], nan=UNLABELLED)
            class_id = class_id.astype(np.int64)
        is_labelled = class_id != UNLABELLED
        filled_id = np.where(is_labelled, class_id, 0)
        maps = complete(recipe, self.name, indices, filled_id, height_m)
        maps["class_id"] = class_id
        maps["traversability"] = np.where(is_labelled, maps["traversability"], np.nan)
        if "classes" in inputs:
            maps["environment"] = np.zeros(len(indices))
        if "photo" in inputs:
            maps["rgb"] = np.rint(inputs["photo"])
        if "traversability" in inputs:
            maps["traversability"] = quantise(inputs["traversability"][:, 0], 16)
        if "drive_count" in inputs:
            maps["drive_count"] = inputs["drive_count"][:, 0]
            maps["drive_std"] = quantise(inputs["drive_std"][:, 0], 16)
        maps["reference_time_s"] = np.full(len(indices), np.nan)
        if recipe.splits[self.name].solvable:
            maps["reference_time_s"] = reference_time_s(recipe, maps)
        for name in self.survey.fields:
            maps[name] = inputs[f"layer {name}"][:, 0]
        for name, stored_field in _fields_of(self.survey).items():
            if name in maps:
                maps[name] = maps[name].astype(stored_field.dtype)
        maps["record kept"] = indices
        maps["record lowest_m"] = lowest_m
        maps["record unlabelled"] = (~is_labelled).sum(axis=(1, 2))
        return maps

    def finish(self) -> None:
        """Write pending maps, and groups of overlapping maps.

        Raises:
            DatasetError: If the split has no map.
        """
        if self.pending:
            self._flush()
        if not self.records["kept"]:
            reasons = []
            for reason, count in self.left_out.items():
                if count:
                    reasons.append(f"{count} {REASONS[reason]}")
            raise DatasetError(
                f"Expected split {self.name!r} to get at least one map, got none from "
                f"{self.survey.layers['dem'].raster.name}. Of "
                f"{self.left_out.total()} candidate maps, {', '.join(reasons)}. Fill "
                "gaps in the rasters, or use smaller maps, other fractions or a recipe "
                "with easier terrain."
            )
        if self.survey.tiling.overlaps:
            self._add_groups()

    def _flush(self) -> None:
        """Write the pending maps to a shard."""
        maps = join_maps(self.pending)
        self.pending = []
        first = len(self.records["kept"])
        for name, values in self.records.items():
            values += maps.pop(f"record {name}").tolist()
        shard = ShardFile(self.name, first, len(self.records["kept"]))
        if shard.maps:
            self.shards.append(shard)
            self._write(shard, maps)

    def _write(self, shard: ShardFile, maps: Maps) -> None:
        entry = self.entry(shard.first, shard.stop)
        content = pack(self.recipe, self.name, entry, maps, _fields_of(self.survey))
        (self.folder / shard.name).write_bytes(content)

    def _add_groups(self) -> None:
        """Rewrite the shards with the group of each map; call it when all maps exist.

        The number of a group is a digest of the terrain and of the group's first map.
        Groups of different terrain therefore have different numbers in a merged
        dataset.
        """
        source = self.survey.source
        keys = ("file", "sha256", "crs", "origin_m", "stride_m")
        terrain = [source[key] for key in keys]
        terrain += self.survey.tiling.shape
        numbers = []
        for first in self.survey.tiling.groups(self.records["kept"]).tolist():
            text = json.dumps([*terrain, first])
            digest = hashlib.sha256(text.encode()).hexdigest()
            numbers.append(int(digest[:13], 16))
        for shard in self.shards:
            maps = TerrainDataset(self.folder / shard.name).read(self.name)
            maps["group"] = np.array(numbers[shard.first : shard.stop])
            self._write(shard, maps)

    def entry(self, first: int = 0, stop: int | None = None) -> dict[str, Any]:
        """Return the manifest entry of consecutive maps, from `first` to before `stop`."""
        records = {name: values[first:stop] for name, values in self.records.items()}
        left_out = {**self.left_out, "between_splits": self.survey.tiling.n_omitted}
        source = {
            **self.survey.source,
            "truth": "unknown",
            **records,
            "left_out": left_out,
        }
        n_maps = len(records["kept"])
        return {
            "scenario": self.recipe.splits[self.name].scenario,
            "maps": n_maps,
            "parts": [{"maps": n_maps, "source": source}],
        }


def _missing_masks(inputs: Maps) -> dict[str, ndarray]:
    """Return masks of maps that lack a required input, by input, bool, shape [B]."""
    masks: dict[str, Any] = {}
    for name, values in inputs.items():
        masks[name] = np.isnan(values).any(axis=(1, 2, 3))
    # With a photo, cells need no class for their colour, so some classes may be
    # missing.
    if "classes" in inputs and "photo" in inputs:
        # Models can learn from measured λ without a class.
        measured = inputs.get("traversability", np.nan)
        is_useless = np.isnan(inputs["classes"]) & np.isnan(measured)
        masks["classes"] = is_useless.all(axis=(1, 2, 3))
    if "drive_count" in inputs:
        masks["drive_count"] = (inputs["drive_count"] == 0).all(axis=(1, 2, 3))
    return masks
