"""Merging of datasets, and of the shards of one dataset.

Splits of the same name are concatenated. Data are copied without decompression: files
into a folder, or their compressed chunks into one file.
"""

import json
import shutil
from collections.abc import Iterator, Sequence
from itertools import chain, combinations, product
from pathlib import Path
from typing import Any

import numpy as np

from benchnav.core.errors import ConfigError, DatasetError
from benchnav.core.settings import plain
from benchnav.core.store import building, resolve_link
from benchnav.datagen import schema
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.hdf5 import (
    Contents,
    assemble,
    contents_of_recipe,
    exclusive_output,
    is_one_file,
    name_of,
)
from benchnav.datagen.files.manifest import is_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.load import recipe_from_dict
from benchnav.datagen.recipe.recipe import Recipe, check_name

# Settings that determine the meaning of maps and must be identical in all datasets.
_SHARED = (
    "height",
    "width",
    "resolution_m",
    "stuck_threshold",
    "classes",
    "environments",
    "occupancy",
    "synthesis",
    "places",
    "correlation_m",
    "layers",
)


def merge(
    paths: Sequence[Path], out: Path, dataset_id: str = "", overwrite: bool = False
) -> Iterator[tuple[int, int]]:
    """Merge datasets, or the shards of one dataset; yield (maps done, total maps).

    Iterate to the end.

    Args:
        paths: paths of two or more datasets, where the first dataset determines the
            order of splits; or of folders with the shards of one dataset.
        out: path of the file to write, if its suffix is `.h5` or `.hdf5`; else path of
            the folder to write.
        dataset_id: id of the new dataset; if empty, the name of `out`. Not used for
            shards, which keep the id of their recipe.
        overwrite: whether to replace an existing dataset.

    Raises:
        DatasetError: If the datasets cannot be merged (with all reasons), one is
            damaged, or shards are missing.
        ConfigError: If `out` exists and may not be replaced.
    """
    out = resolve_link(out)
    finished = [path for path in paths if is_dataset(path) or not path.is_dir()]
    if finished and len(finished) < len(paths):
        raise DatasetError(
            "Expected either finished datasets or folders with shards of one dataset, "
            "got both. Merge the shards first."
        )
    name = dataset_id or name_of(out)
    contents = _merged_datasets(finished, name) if finished else _merged_shards(paths)
    total = sum(entry["maps"] for entry in contents.splits.values())
    done = 0
    sources = dict.fromkeys(chain(*contents.files.values()))
    with exclusive_output(out, overwrite):
        for path in sources:
            if faults := find_faults(path):
                raise DatasetError(
                    f"{path} is damaged: {faults[0]}. Run `benchnav-datagen validate` "
                    "on it, which explains how to create it again."
                )
            done += sum(entry["maps"] for entry in TerrainDataset(path).splits.values())
            yield done, total
        if is_one_file(out):
            assemble(contents, out.parent, out)
            return
        with building(out) as folder:
            copies: dict[Path, Path] = {}
            for path in sources:
                copy = folder / path.name
                if copy.exists():
                    copy = folder / f"{len(copies)}-{path.name}"
                copies[path] = copy
                shutil.copy2(path, copy)
            files = {
                split: [copies[path] for path in split_files]
                for split, split_files in contents.files.items()
            }
            assemble(contents._replace(files=files), folder, out)


def _merged_datasets(paths: Sequence[Path], dataset_id: str) -> Contents:
    """Return the contents of the merged dataset.

    Raises:
        DatasetError: If the datasets cannot be merged, with all reasons.
    """
    datasets = [TerrainDataset(path) for path in paths]
    reasons = list(merge_obstacles(datasets))
    if len(datasets) < 2:
        reasons.append("fewer than two files")
    try:
        check_name("id", dataset_id)
    except ConfigError as error:
        reasons.append(str(error).rstrip("."))
    if reasons:
        raise DatasetError(
            f"Expected datasets that can be merged, got: {'; '.join(reasons)}."
        )
    recipes: list[Recipe] = []
    splits: dict[str, schema.Json] = {}
    files: dict[str, list[Path]] = {}
    for dataset in datasets:
        dataset_recipes = [
            recipe_from_dict(data, f"in {dataset.path}")
            for data in dataset.manifest["recipes"]
        ]
        recipes += [recipe for recipe in dataset_recipes if recipe not in recipes]
        for name, entry in dataset.splits.items():
            paths_of_split = [piece.path for piece in dataset.pieces[name]]
            files.setdefault(name, []).extend(paths_of_split)
            empty = {"scenario": entry["scenario"], "maps": 0, "parts": []}
            merged = splits.setdefault(name, empty)
            merged["maps"] += entry["maps"]
            for part in entry["parts"]:
                if "recipe" in part:
                    recipe = dataset_recipes[part["recipe"]]
                    part = {**part, "recipe": recipes.index(recipe)}
                merged["parts"].append(part)
    return Contents(dataset_id, recipes, splits, files, datasets[0].fields)


def _merged_shards(folders: Sequence[Path]) -> Contents:
    """Return the contents of the dataset whose shards are in some folders.

    Raises:
        DatasetError: If the folders contain no shards, or shards of several recipes or
            versions, or some shards are missing.
    """
    paths = [path for folder in folders for path in sorted(folder.glob("*.h5"))]
    shards = [TerrainDataset(path) for path in paths]
    if not shards:
        raise DatasetError(
            "Expected datasets, or folders with shards of one dataset, got "
            f"{', '.join(map(str, folders))} without .h5 files. Pass other folders."
        )
    for shard, name in product(shards, ("recipes", "generator")):
        if shard.manifest[name] != shards[0].manifest[name]:
            raise DatasetError(
                f"Expected shards of one dataset, got {shards[0].path} and "
                f"{shard.path}, which differ in `{name}`. Pass only shards of one "
                "dataset."
            )
    recipe = shards[0].recipe
    files: dict[str, list[Path]] = {}
    missing = []
    for name, spec in recipe.splits.items():
        by_first = {
            shard.splits[name]["parts"][0]["first"]: shard
            for shard in shards
            if name in shard.splits
        }
        files[name] = []
        expected_first = 0
        for first in (*sorted(by_first), spec.maps):
            if first != expected_first:
                missing.append(f"maps {expected_first}–{first - 1} of {name}")
            if first in by_first:
                shard = by_first[first]
                files[name].append(shard.path)
                expected_first = first + shard.splits[name]["maps"]
    if missing:
        raise DatasetError(
            f"Expected all shards of {recipe.id}, got no shards with "
            f"{'; '.join(missing)}. Create the missing shards first."
        )
    return contents_of_recipe(recipe, files)


def merge_obstacles(datasets: Sequence[TerrainDataset]) -> Iterator[str]:
    """Yield the reasons why datasets cannot be merged, one text per pair."""
    with_digests = [(dataset, _elevation_digests(dataset)) for dataset in datasets]
    for (first, digests_1), (second, digests_2) in combinations(with_digests, 2):
        reasons = list(_differences(first, second))
        common = np.intersect1d(digests_1, digests_2)
        if len(common):
            reasons.append(f"{len(common)} map(s) in common")
        if reasons:
            yield f"{first.path} and {second.path} have {', '.join(reasons)}"


def _differences(first: TerrainDataset, second: TerrainDataset) -> Iterator[str]:
    """Yield the differences between two datasets that prevent a merge, as texts."""
    fields = first.fields
    if extra := sorted(set(fields) ^ set(second.fields)):
        hint = ""
        if extra == ["group"]:
            hint = ": import both with overlapping maps or both without, by --stride"
        yield f"different fields ({', '.join(extra)} only in one dataset{hint})"
    elif list(fields.items()) != list(second.fields.items()):
        changed = [name for name in fields if fields[name] != second.fields[name]]
        if changed:
            yield f"fields of different dtype, unit or meaning ({', '.join(changed)})"
        else:
            orders = f"{', '.join(fields)} / {', '.join(second.fields)}"
            yield f"different order of fields ({orders})"
    ours = plain(first.recipe)
    theirs = plain(second.recipe)
    for name in _SHARED:
        if ours[name] != theirs[name]:
            is_long = name in ("classes", "layers")
            values = "" if is_long else f" ({ours[name]} / {theirs[name]})"
            yield f"different {name}{values}"
    for split in sorted(set(first.splits) & set(second.splits)):
        if len(_kinds(first, split) | _kinds(second, split)) > 1:
            yield f"different scenarios or `solvable` in split {split!r}"


def _kinds(dataset: TerrainDataset, split: str) -> set[str]:
    """Return scenario and `solvable` of each part of a split, as JSON texts."""
    kinds = set()
    for part in dataset.splits[split]["parts"]:
        kind: Any = "imported"
        if "recipe" in part:
            recipe = dataset.manifest["recipes"][part["recipe"]]
            spec = recipe["splits"][part["split"]]
            scenario = spec["scenario"]
            kind = [scenario, recipe["scenarios"][scenario], spec["solvable"]]
        kinds.add(json.dumps(kind, sort_keys=True))
    return kinds


def _elevation_digests(dataset: TerrainDataset) -> np.ndarray:
    """Return the digests of all elevation maps, shape [N]."""
    column = dataset.field_names.index("elevation_m")
    digests = np.concatenate([dataset.entry_digests(split) for split in dataset.splits])
    digests = np.ascontiguousarray(digests[:, column])
    return digests.view(f"S{schema.DIGEST_BYTES}").ravel()
