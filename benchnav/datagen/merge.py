"""Combines datasets: splits side by side, and those of one name end to end."""

import re
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from benchnav.datagen import schema
from benchnav.datagen.block import Block
from benchnav.datagen.scenario import Recipe, recipe_from_dict
from benchnav.datagen.store import TerrainDataset
from benchnav.datagen.writer import check_target, named_errors, writing
from benchnav.errors import DatasetError

_BLOCK_MAPS = 64

# What a map's meaning rests on: alike in all files of a merge.
_SHARED = (
    "height", "width", "resolution_m", "stuck_threshold", "classes", "environments", "occupancy",
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
    check_target(out, overwrite)
    datasets = [TerrainDataset(path) for path in paths]
    reasons = list(why_unlike(datasets))
    if len(datasets) < 2:
        reasons.append("fewer than two files")
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", dataset_id):
        reasons.append(f"id {dataset_id!r} is not of letters, digits, '.', '_' and '-'")
    if reasons:
        raise DatasetError(f"Expected datasets that can be merged, got: {'; '.join(reasons)}.")
    recipes, splits = _table_of_contents(datasets)
    total, done = sum(entry["maps"] for entry in splits.values()), 0
    with named_errors(out), writing(out, dataset_id, recipes, splits) as write:
        for split in splits:
            for dataset in datasets:
                maps = dataset.splits.get(split, {"maps": 0})["maps"]
                for start in range(0, maps, _BLOCK_MAPS):
                    indices = range(start, min(start + _BLOCK_MAPS, maps))
                    write(split, _read_checked(dataset, split, indices))
                    done += len(indices)
                    yield done, total


def why_unlike(datasets: Sequence[TerrainDataset]) -> Iterator[str]:
    """Gives every reason why datasets cannot be one."""
    for first, second in combinations(datasets, 2):
        ours, theirs = first.recipe, second.recipe
        pair = f"{first.path} and {second.path}"
        for name in _SHARED:
            if getattr(ours, name) != getattr(theirs, name):
                values = "" if name == "classes" else f" ({getattr(ours, name)}, {getattr(theirs, name)})"
                yield f"{pair} have unlike {name}{values}"
        for split in sorted(set(first.splits) & set(second.splits)):
            yield from (f"{pair} {reason}" for reason in _unlike_split(ours, theirs, split))
        common = np.intersect1d(_fingerprints(first), _fingerprints(second))
        if len(common):
            yield f"{pair} have {len(common)} map(s) in common"


def _unlike_split(ours: Recipe, theirs: Recipe, split: str) -> Iterator[str]:
    if split not in ours.splits or split not in theirs.splits:
        return
    one, other = ours.splits[split], theirs.splits[split]
    if one.scenario != other.scenario or ours.scenarios[one.scenario] != theirs.scenarios[other.scenario]:
        yield f"have unlike scenarios in split {split!r}"
    if one.solvable != other.solvable:
        yield f"have unlike `solvable` in split {split!r}"


def _fingerprints(dataset: TerrainDataset) -> np.ndarray:
    """The digests of all elevation maps, shape [N]."""
    column = list(schema.FIELDS).index("elevation_m")
    with dataset.open() as file:
        digests = [file[split][schema.ENTRY_DIGESTS][:, column] for split in dataset.splits]
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
    with dataset.open() as file:
        stored = file[split][schema.ENTRY_DIGESTS][indices.start : indices.stop]
    if not np.array_equal(stored, block.digests):
        raise DatasetError(
            f"Maps of split {split!r} in {dataset.path} do not match their digests. "
            "Run `benchnav-datagen validate` on it, and `repair`."
        )
    return block
