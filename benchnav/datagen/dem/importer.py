"""Real ground: rasters into maps of the dataset schema.

Slopes follow from the real elevation, at a map's edge too, where that of the ground
beyond is read. What the rasters do not say comes from the recipe. The truth of λ, its
distribution in each cell, is not known of real ground: `Terrain.truth` is what the
recipe's class table would make it, and the dataset says that it is unknown.

Maps that overlap say the same of the same ground. So they are stored with a `group`,
the statistical unit: maps of one group overlap, directly or by others between them, and
maps of two groups share no ground. Where all maps of a split are connected, it is one
group, and statistics have one unit. Cutting such ground into smaller groups would need
maps to be left out between them, and gives no more units than maps side by side.
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

from benchnav.core.errors import DatasetError, expect
from benchnav.core.store import building, real_place
from benchnav.datagen.dem.drive_log import Drives
from benchnav.datagen.dem.extent import MAX_RELIEF_M
from benchnav.datagen.dem.raster import Cut, Rasters, load_rasterio
from benchnav.datagen.dem.survey import Survey
from benchnav.datagen.dem.tiling import Run
from benchnav.datagen.files.create import SHARD_CELLS
from benchnav.datagen.files.hdf5 import Contents, ShardFile, assemble, held, pack
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
# of rasters that GDAL keeps; what it would choose grows with the machine
_CACHE_BYTES = 2**29

# Why maps are left out, in the order of being found.
REASONS = {
    "not_driven": "have no cell that a drive of their split crossed",
    "missing_elevation": "have cells without elevation",
    "too_rough": f"span more than {MAX_RELIEF_M:g} m of elevation",
    "missing_classes": "have no cell with a class or measured λ, or have cells with "
    "neither class nor photo",
    "missing_colours": "have cells without colour",
    "not_solvable": "have a goal that cannot be reached",
}
_LACKING = {
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
    """Makes a dataset from rasters, yielding (maps done, maps in all); to be iterated
    to the end.

    Maps with cells without elevation or colour are left out. Cells without a class, a
    measured λ or a value of a layer are kept as such. A map's random numbers go by its
    number in the ground, so they are the same whichever others are left out.

    Args:
        dem: elevations, by any name that rasterio opens.
        out: file to write, of suffix `.h5` or `.hdf5`; else a folder.
        recipe: id of the dataset, size, resolution, start and goal of the maps, class
            table, light, seed.
        rasters: where classes, colours, λ and layers come from.
        drives: log of drives that λ comes from, around which the ground is cut; maps
            that none crossed are left out.
        cut: which maps are cut out of the ground.
        overwrite: replace what is there.
        announce: is given what will be imported, in sentences, before anything is read.

    Raises:
        ConfigError: rasterio is not installed, a setting does not fit the recipe, or
            `out` is taken.
        DatasetError: a raster does not fit, a split is left without maps, or `out`
            cannot be written.
    """
    expect(
        drives is None or not rasters.traversability,
        "λ from `drives` or from `traversability`, got both. Leave one out.",
    )
    expect(
        not (cut.solvable and rasters.unlabelled),
        "`classes` with `solvable`, which goes by the class table, got none. Leave "
        "`solvable` out, or pass --classes.",
    )
    affecting = [spec.name for spec in recipe.layers if spec.affects]
    expect(
        not affecting,
        "a recipe whose `layers` leave λ as it is, since an import draws none, got "
        f"{', '.join(affecting)}.",
    )
    out = real_place(out)
    splits = {
        name: Split(scenario=cut.scenario, maps=1, solvable=cut.solvable)
        for name in cut.shares
    }
    recipe = replace(recipe, splits=splits)
    with ExitStack() as stack:
        stack.enter_context(held(out, overwrite))
        stack.enter_context(load_rasterio().Env(GDAL_CACHEMAX=_CACHE_BYTES))
        survey = Survey(stack, dem, rasters, recipe, cut, drives, announce)
        folder = stack.enter_context(building(out))
        parts = {name: _Part(name, recipe, folder, survey) for name in splits}
        done = 0
        for run in survey.tiling.runs(recipe.grid.maps_in(_CELLS_AT_ONCE)):
            parts[run.split].add(run)
            done += len(run.columns)
            yield done, survey.tiling.maps
        for name in set(survey.fields) - survey.valued:
            raster = survey.layers[f"layer {name}"].raster.name
            raise DatasetError(
                f"Expected `layer {name}` with a value on some map, got none in "
                f"{raster}."
            )
        for part in parts.values():
            part.finish()
        sizes = {
            name: replace(splits[name], maps=len(part.about["kept"]))
            for name, part in parts.items()
        }
        contents = Contents(
            id=recipe.id,
            recipes=[replace(recipe, splits=sizes)],
            splits={name: part.entry() for name, part in parts.items()},
            files={
                name: [folder / shard.name for shard in part.shards]
                for name, part in parts.items()
            },
            fields=_fields_of(survey),
        )
        assemble(contents, folder, out)


def _fields_of(ground: Survey) -> Fields:
    """What the maps have; groups are added when all maps are known."""
    names = ["group"] * ground.tiling.overlaps + ["drive_count", "drive_std"] * (
        ground.driven is not None
    )
    return (
        FIELDS
        | {name: OPTIONAL[name] for name in OPTIONAL if name in names}
        | ground.fields
    )


@dataclass
class _Part:
    """What has become of the maps of one split: shards of those kept, what is said of
    each, counts of the others.
    """

    name: str
    recipe: Recipe
    folder: Path
    ground: Survey
    about: dict[str, list[Any]] = field(
        default_factory=lambda: {"kept": [], "lowest_m": [], "unlabelled": []}
    )
    left_out: Counter[str] = field(default_factory=Counter)
    shards: list[ShardFile] = field(default_factory=list)
    pending: list[Maps] = field(default_factory=list)

    def add(self, run: Run) -> None:
        """Makes maps and counts those that are left out; writes a shard where enough
        are kept.
        """
        recipe = self.recipe
        framed_m, given = self.ground.read(run)
        kept = np.ones(len(run.columns), dtype=bool)
        lacking = {
            name: np.isnan(values).any(axis=(1, 2, 3)) for name, values in given.items()
        }
        if (
            "classes" in given and "photo" in given
        ):  # else a cell is painted in the colour of its class
            # A measured λ is worth learning from without a class.
            unknown = np.isnan(given["classes"]) & np.isnan(
                given.get("traversability", np.nan)
            )
            lacking["classes"] = unknown.all(axis=(1, 2, 3))
        if "drive_count" in given:
            lacking["drive_count"] = (given["drive_count"] == 0).all(axis=(1, 2, 3))
        for reason, name in _LACKING.items():
            if name in lacking:
                self.left_out[reason] += int((kept & lacking[name]).sum())
                kept &= ~lacking[name]
        relief_m = np.ptp(framed_m[:, 1:-1, 1:-1], axis=(1, 2))
        rough = kept & (relief_m > MAX_RELIEF_M)
        if rough.any():
            self.left_out["too_rough"] += int(rough.sum())
            kept &= ~rough
        numbers = (run.row * self.ground.tiling.tiles[1] + np.array(run.columns))[kept]
        if not len(numbers):
            return
        framed_m, given = (
            quantise(framed_m[kept], 13),
            {name: values[kept] for name, values in given.items()},
        )
        lowest_m = framed_m[:, 1:-1, 1:-1].min(axis=(1, 2))
        class_id = class_map(recipe, self.name, numbers)
        if "classes" in given:
            class_id = np.nan_to_num(given["classes"][:, 0], nan=UNLABELLED).astype(
                np.int64
            )
        labelled = class_id != UNLABELLED
        height_m = framed_m - lowest_m[:, None, None]
        maps = complete(
            recipe, self.name, numbers, np.where(labelled, class_id, 0), height_m
        )
        maps["class_id"] = class_id
        maps["traversability"] = np.where(labelled, maps["traversability"], np.nan)
        if "classes" in given:
            maps["environment"] = np.zeros(len(numbers))
        if "photo" in given:
            maps["rgb"] = np.rint(given["photo"])
        if "traversability" in given:
            maps["traversability"] = quantise(given["traversability"][:, 0], 16)
        if "drive_count" in given:
            maps["drive_count"] = given["drive_count"][:, 0]
            maps["drive_std"] = quantise(given["drive_std"][:, 0], 16)
        maps["reference_time_s"] = np.full(len(numbers), np.nan)
        if recipe.splits[self.name].solvable:
            maps["reference_time_s"] = reference_time_s(recipe, maps)
        solved = ~np.isinf(maps["reference_time_s"])
        self.left_out["not_solvable"] += int((~solved).sum())
        about = {
            "kept": numbers,
            "lowest_m": lowest_m,
            "unlabelled": (~labelled).sum(axis=(1, 2)),
        }
        maps |= {name: given[f"layer {name}"][:, 0] for name in self.ground.fields}
        fields = {
            name: kind
            for name, kind in _fields_of(self.ground).items()
            if name != "group"
        }
        stored = {name: maps[name].astype(kind.dtype) for name, kind in fields.items()}
        stored |= {f"about {name}": values for name, values in about.items()}
        self.pending.append({name: values[solved] for name, values in stored.items()})
        if sum(maps["class_id"].size for maps in self.pending) >= SHARD_CELLS:
            self._flush()

    def finish(self) -> None:
        """Writes what is pending, and groups where maps overlap.

        Raises:
            DatasetError: no map was kept.
        """
        if self.pending:
            self._flush()
        if not self.about["kept"]:
            reasons = [
                f"{count} {REASONS[reason]}"
                for reason, count in self.left_out.items()
                if count
            ]
            raise DatasetError(
                f"Expected split {self.name!r} to get at least one map, got none from "
                f"{self.ground.layers['dem'].raster.name}: of "
                f"{self.left_out.total()}, {', '.join(reasons)}. Fill the gaps, or "
                "take smaller maps, other shares "
                "or a recipe of easier ground."
            )
        if self.ground.tiling.overlaps:
            self._add_groups()

    def _flush(self) -> None:
        maps = join_maps(self.pending)
        first = len(self.about["kept"])
        for name, values in self.about.items():
            values += maps.pop(f"about {name}").tolist()
        shard = ShardFile(self.name, first, len(self.about["kept"]))
        self.pending = []
        if shard.maps:
            self.shards.append(shard)
            self._write(shard, maps)

    def _write(self, shard: ShardFile, maps: Maps) -> None:
        about = self.entry(shard.first, shard.stop)
        content = pack(self.recipe, self.name, about, maps, _fields_of(self.ground))
        (self.folder / shard.name).write_bytes(content)

    def _add_groups(self) -> None:
        """Writes the shards anew with each map's group, which is known only when all
        maps are.

        Of the ground and its least map the number is a digest, so that datasets can be
        merged: the same on the same ground, and else another.
        """
        source = self.ground.source
        about = [
            source[key] for key in ("file", "sha256", "crs", "origin_m", "stride_m")
        ]
        about += self.ground.tiling.shape
        firsts = self.ground.tiling.groups(self.about["kept"]).tolist()
        texts = (json.dumps([*about, first]).encode() for first in firsts)
        numbers = np.array(
            [int(hashlib.sha256(text).hexdigest()[:13], 16) for text in texts]
        )
        for shard in self.shards:
            maps = TerrainDataset(self.folder / shard.name).read(self.name)
            maps["group"] = numbers[shard.first : shard.stop]
            self._write(shard, maps)

    def entry(self, first: int = 0, stop: int | None = None) -> dict[str, Any]:
        """The manifest's entry of the maps from one on, to the last or before another."""
        kept = {name: values[first:stop] for name, values in self.about.items()}
        left_out = {**self.left_out, "between_splits": self.ground.tiling.between}
        source = {
            **self.ground.source,
            "truth": "unknown",
            **kept,
            "left_out": left_out,
        }
        count, scenario = len(kept["kept"]), self.recipe.splits[self.name].scenario
        return {
            "scenario": scenario,
            "maps": count,
            "parts": [{"maps": count, "source": source}],
        }
