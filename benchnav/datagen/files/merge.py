"""Combines datasets: splits side by side, and those of one name end to end."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, is_dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from benchnav.datagen import schema
from benchnav.datagen.files.block import BLOCK_MAPS, Block, spans
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.files.writer import check_target, writing
from benchnav.datagen.recipe.recipe import Recipe, recipe_from_dict
from benchnav.datagen.recipe.rules import check_name
from benchnav.errors import ConfigError, DatasetError

# What a map's meaning rests on: alike in all files of a merge.
_SHARED = (
    "height", "width", "resolution_m", "stuck_threshold", "classes", "environments", "occupancy",
    "synthesis", "places", "correlation_m",
)  # fmt: skip


def merge(
    paths: Sequence[Path], out: Path, dataset_id: str, overwrite: bool = False
) -> Iterator[tuple[int, int]]:
    """Writes the maps of several datasets to one; yields (maps done, maps in all).

    Args:
        paths: two or more files. The first fixes the order of splits.
        out: file to write.
        dataset_id: id of the new dataset.
        overwrite: replace a file that is there.

    Raises:
        DatasetError: the datasets are unlike, with every reason; one is damaged; or `out` exists.
    """
    check_target(out, overwrite=True)
    datasets = [TerrainDataset(path) for path in paths]
    reasons = list(why_unlike(datasets))
    if len(datasets) < 2:
        reasons.append("fewer than two files")
    try:
        check_name("id", dataset_id)
    except ConfigError as error:
        reasons.append(str(error).rstrip("."))
    if reasons:
        raise DatasetError(f"Expected datasets that can be merged, got: {'; '.join(reasons)}.")
    recipes, splits = _table_of_contents(datasets)
    total, done = sum(entry["maps"] for entry in splits.values()), 0
    with writing(out, dataset_id, recipes, splits, overwrite) as write:
        for split in splits:
            for dataset in datasets:
                maps = dataset.splits.get(split, {"maps": 0})["maps"]
                for start, stop in spans(maps, BLOCK_MAPS):
                    write(split, _read_checked(dataset, split, range(start, stop)))
                    done += stop - start
                    yield done, total


def why_unlike(datasets: Sequence[TerrainDataset]) -> Iterator[str]:
    """Gives every reason why datasets cannot be one: a sentence a pair of them, which names both once."""
    prints = [_fingerprints(dataset) for dataset in datasets]
    for one, other in combinations(range(len(datasets)), 2):
        first, second = datasets[one], datasets[other]
        reasons = list(_differences(first, second))
        common = np.intersect1d(prints[one], prints[other])
        if len(common):
            reasons.append(f"{len(common)} map(s) in common")
        if reasons:
            yield f"{first.path} and {second.path} have {', '.join(reasons)}"


def _differences(first: TerrainDataset, second: TerrainDataset) -> Iterator[str]:
    for name in _SHARED:
        ours, theirs = getattr(first.recipe, name), getattr(second.recipe, name)
        if ours != theirs:
            yield f"unlike {name}" + (
                "" if name == "classes" else f" ({_in_words(ours)} / {_in_words(theirs)})"
            )
    for split in sorted(set(first.splits) & set(second.splits)):
        if not _kinds(first, split) | _kinds(second, split) <= _kinds(first, split) & _kinds(second, split):
            yield f"unlike scenarios or `solvable` in split {split!r}"


def _in_words(value: Any) -> str:
    """A value of a recipe as its YAML file has it."""
    if is_dataclass(value) and not isinstance(value, type):
        return ", ".join(f"{name} {item}" for name, item in asdict(value).items())
    return "none" if value is None else str(value)


def _kinds(dataset: TerrainDataset, split: str) -> set[str]:
    """What the maps of a split are by their recipes: scenario, and whether all can be solved."""
    kinds = set()
    for part in dataset.splits[split]["parts"]:
        if "recipe" not in part:
            kinds.add("imported")
            continue
        recipe = dataset.manifest["recipes"][part["recipe"]]
        spec = recipe["splits"][part["split"]]
        scenario = recipe["scenarios"][spec["scenario"]]
        kinds.add(json.dumps([spec["scenario"], scenario, spec["solvable"]], sort_keys=True))
    return kinds


def _fingerprints(dataset: TerrainDataset) -> np.ndarray:
    """The digests of all elevation maps, shape [N]."""
    column = list(schema.FIELDS).index("elevation_m")
    digests = [dataset.entry_digests(split)[:, column] for split in dataset.splits]
    return np.ascontiguousarray(np.concatenate(digests)).view(f"S{schema.DIGEST_BYTES}").ravel()


def _table_of_contents(datasets: Sequence[TerrainDataset]) -> tuple[list[Recipe], dict[str, dict[str, Any]]]:
    """Gathers the recipes, each once, and the parts of each split that refer to them."""
    recipes: list[Recipe] = []
    splits: dict[str, dict[str, Any]] = {}
    for dataset in datasets:
        own = [recipe_from_dict(data, f"in {dataset.path}") for data in dataset.manifest["recipes"]]
        recipes += [recipe for recipe in own if recipe not in recipes]
        for name, entry in dataset.splits.items():
            gathered = splits.setdefault(name, {"scenario": entry["scenario"], "maps": 0, "parts": []})
            gathered["maps"] += entry["maps"]
            for part in entry["parts"]:
                number = {"recipe": recipes.index(own[part["recipe"]])} if "recipe" in part else {}
                gathered["parts"].append({**part, **number})
    return recipes, splits


def _read_checked(dataset: TerrainDataset, split: str, indices: range) -> Block:
    block = Block.of(dataset.read(split, indices))
    if not np.array_equal(dataset.entry_digests(split, indices), block.digests):
        raise DatasetError(
            f"Maps of split {split!r} in {dataset.path} do not match their digests. "
            "Run `benchnav-datagen validate` on it, and `repair`."
        )
    return block
