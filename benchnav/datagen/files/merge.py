"""Combines datasets: splits side by side, those of one name end to end; and the shards
of one dataset.

What is merged is packed already: files are copied into a folder, or their chunks into
one file.
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
from benchnav.core.store import building, real_place
from benchnav.datagen import schema
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.hdf5 import (
    Contents,
    assemble,
    held,
    is_one_file,
    name_of,
    whole,
)
from benchnav.datagen.files.manifest import is_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import Recipe, check_name, recipe_from_dict

# What a map's meaning rests on: alike in all files of a merge.
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
    """Writes the maps of several datasets, or of the shards of one, to one; yields
    (maps done, maps in all).

    Args:
        paths: two or more datasets, of which the first fixes the order of splits; or
            folders of shards.
        out: file to write, of suffix `.h5` or `.hdf5`; else a folder.
        dataset_id: id of the new dataset; the name of `out` when empty. Shares keep
            that of their recipe.
        overwrite: replace what is there.

    Raises:
        DatasetError: the datasets are unlike, with every reason; one is damaged; or
            shards are missing.
        ConfigError: `out` is taken.
    """
    out = real_place(out)
    finished = [path for path in paths if is_dataset(path) or not path.is_dir()]
    if finished and len(finished) < len(paths):
        raise DatasetError(
            "Expected datasets, or shards of one dataset, got both. Merge them apart."
        )
    name = dataset_id or name_of(out)
    contents = _of_datasets(finished, name) if finished else _of_shards(paths)
    total, done = sum(entry["maps"] for entry in contents.splits.values()), 0
    sources = dict.fromkeys(chain(*contents.files.values()))
    with held(out, overwrite):
        for path in sources:
            if faults := find_faults(path):
                raise DatasetError(
                    f"{path} is damaged: {faults[0]}. Run `benchnav-datagen validate` "
                    "on it, which says how to make "
                    "it anew."
                )
            done += sum(entry["maps"] for entry in TerrainDataset(path).splits.values())
            yield done, total
        if is_one_file(out):
            assemble(contents, out.parent, out)
            return
        with building(out) as folder:
            copies: dict[Path, Path] = {}
            for path in sources:
                # Under its own name where that is free.
                name = (
                    f"{len(copies)}-{path.name}"
                    if (folder / path.name).exists()
                    else path.name
                )
                copies[path] = folder / name
                shutil.copy2(path, copies[path])
            files = {
                split: [copies[path] for path in own]
                for split, own in contents.files.items()
            }
            assemble(contents._replace(files=files), folder, out)


def _of_datasets(paths: Sequence[Path], dataset_id: str) -> Contents:
    datasets = [TerrainDataset(path) for path in paths]
    reasons = list(why_unlike(datasets))
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
    # The recipes, each once, and of each split the parts that refer to them and the
    # files.
    recipes: list[Recipe] = []
    splits: dict[str, schema.Json] = {}
    files: dict[str, list[Path]] = {}
    for dataset in datasets:
        own = [
            recipe_from_dict(data, f"in {dataset.path}")
            for data in dataset.manifest["recipes"]
        ]
        recipes += [recipe for recipe in own if recipe not in recipes]
        for name, entry in dataset.splits.items():
            files.setdefault(name, []).extend(
                piece.path for piece in dataset.pieces[name]
            )
            gathered = splits.setdefault(
                name, {"scenario": entry["scenario"], "maps": 0, "parts": []}
            )
            gathered["maps"] += entry["maps"]
            for part in entry["parts"]:
                number = (
                    {"recipe": recipes.index(own[part["recipe"]])}
                    if "recipe" in part
                    else {}
                )
                gathered["parts"].append({**part, **number})
    return Contents(dataset_id, recipes, splits, files, datasets[0].fields)


def _of_shards(folders: Sequence[Path]) -> Contents:
    """Gathers the shards that lie in folders.

    Raises:
        DatasetError: there are none, they are of several recipes or versions, or some
            are missing.
    """
    shards = [
        TerrainDataset(path)
        for folder in folders
        for path in sorted(folder.glob("*.h5"))
    ]
    if not shards:
        raise DatasetError(
            "Expected datasets, or folders with shards of one, got "
            f"{', '.join(map(str, folders))} without any."
        )
    for shard, name in product(shards, ("recipes", "generator")):
        if shard.manifest[name] != shards[0].manifest[name]:
            raise DatasetError(
                f"Expected shards of one dataset, got {shards[0].path} and "
                f"{shard.path} with unlike {name}."
            )
    recipe = shards[0].recipe
    files: dict[str, list[Path]] = {}
    lacking = []
    for name, spec in recipe.splits.items():
        own = {
            shard.splits[name]["parts"][0]["first"]: shard
            for shard in shards
            if name in shard.splits
        }
        place, files[name] = 0, []
        for begin in (*sorted(own), spec.maps):
            if begin != place:
                lacking.append(f"maps {place}–{begin - 1} of {name}")
            if begin in own:
                files[name].append(own[begin].path)
                place = begin + own[begin].splits[name]["maps"]
    if lacking:
        raise DatasetError(
            f"Expected all shards of {recipe.id}, got none with {'; '.join(lacking)}. "
            "Make the missing shards first."
        )
    return whole(recipe, files)


def why_unlike(datasets: Sequence[TerrainDataset]) -> Iterator[str]:
    """Gives every reason why datasets cannot be one: a sentence a pair of them, which
    names both once.
    """
    prints = [(dataset, _fingerprints(dataset)) for dataset in datasets]
    for (first, ours), (second, theirs) in combinations(prints, 2):
        reasons = list(_differences(first, second))
        common = np.intersect1d(ours, theirs)
        if len(common):
            reasons.append(f"{len(common)} map(s) in common")
        if reasons:
            yield f"{first.path} and {second.path} have {', '.join(reasons)}"


def _differences(first: TerrainDataset, second: TerrainDataset) -> Iterator[str]:
    if extra := sorted(set(first.fields) ^ set(second.fields)):
        hint = (
            ": import both with overlap or both without, by --stride"
            if extra == ["group"]
            else ""
        )
        yield f"unlike fields ({', '.join(extra)} of one alone{hint})"
    elif list(first.fields.items()) != list(second.fields.items()):
        changed = [
            name for name in first.fields if first.fields[name] != second.fields[name]
        ]
        yield (
            f"fields of unlike dtype, unit or meaning ({', '.join(changed)})"
            if changed
            else (
                f"unlike order of fields ({', '.join(first.fields)} / "
                f"{', '.join(second.fields)})"
            )
        )
    ours, theirs = plain(first.recipe), plain(second.recipe)
    for name in _SHARED:
        if ours[name] != theirs[name]:
            is_long = name in ("classes", "layers")
            yield f"unlike {name}" + (
                "" if is_long else f" ({ours[name]} / {theirs[name]})"
            )
    for split in sorted(set(first.splits) & set(second.splits)):
        if len(_kinds(first, split) | _kinds(second, split)) > 1:
            yield f"unlike scenarios or `solvable` in split {split!r}"


def _kinds(dataset: TerrainDataset, split: str) -> set[str]:
    """What the maps of a split are by their recipes: scenario, and whether all can be
    solved.
    """
    kinds = set()
    for part in dataset.splits[split]["parts"]:
        kind: Any = "imported"
        if "recipe" in part:
            recipe = dataset.manifest["recipes"][part["recipe"]]
            spec = recipe["splits"][part["split"]]
            kind = [
                spec["scenario"],
                recipe["scenarios"][spec["scenario"]],
                spec["solvable"],
            ]
        kinds.add(json.dumps(kind, sort_keys=True))
    return kinds


def _fingerprints(dataset: TerrainDataset) -> np.ndarray:
    """The digests of all elevation maps, shape [N]."""
    column = dataset.field_names.index("elevation_m")
    digests = np.concatenate([dataset.entry_digests(split) for split in dataset.splits])
    return (
        np.ascontiguousarray(digests[:, column]).view(f"S{schema.DIGEST_BYTES}").ravel()
    )
