"""Makes the damaged maps of a dataset anew, and only those."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchnav.datagen import schema
from benchnav.datagen.files.block import BLOCK_MAPS, Block, spans
from benchnav.datagen.files.check import Fault
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.files.writer import writing
from benchnav.datagen.recipe.recipe import Recipe, recipe_from_dict
from benchnav.datagen.synth.generate import Maps, generate
from benchnav.errors import DatasetError


def maps_to_make(dataset: TerrainDataset, faults: list[Fault]) -> dict[str, np.ndarray]:
    """Tells which maps a repair has to make anew.

    Args:
        dataset: the damaged file.
        faults: what `check.find_faults` found in it.

    Returns:
        Indices by split, ascending. A fault that names no map makes all maps of its split suspect;
        one of the digests stored beside the maps makes none.
    """
    chosen = {}
    for split, entry in dataset.splits.items():
        found = [fault for fault in faults if fault.split == split and fault.field != schema.ENTRY_DIGESTS]
        if any(fault.map < 0 for fault in found):
            chosen[split] = np.arange(entry["maps"])
        else:
            chosen[split] = np.unique([fault.map for fault in found if fault.map >= 0]).astype(np.int64)
    return chosen


def repair(dataset: TerrainDataset, chosen: dict[str, np.ndarray]) -> Iterator[tuple[int, int]]:
    """Rewrites a dataset with some maps made anew; yields (maps done, maps in all).

    The file is replaced only when every split then has the digest that the manifest names.

    Args:
        dataset: the damaged file.
        chosen: maps to make anew by split, from `maps_to_make`.

    Raises:
        DatasetError: a map was not made by a recipe, or what is made or read is not what the
            manifest names.
    """
    refused = [reason for split, indices in chosen.items() for reason in _lost(dataset, split, indices)]
    if refused:
        raise DatasetError(f"Expected maps that a recipe can make anew; {'; '.join(refused)}.")
    manifest, (height, width) = dataset.manifest, dataset.grid.shape
    recipes = [recipe_from_dict(data, f"in {dataset.path}") for data in manifest["recipes"]]
    splits = {
        name: {key: value for key, value in entry.items() if key != "digest"}
        for name, entry in dataset.splits.items()
    }
    total, done = sum(entry["maps"] for entry in splits.values()), 0
    # Through a link, so that the file is mended and not the link replaced.
    with writing(dataset.path.resolve(), dataset.id, recipes, splits, overwrite=True) as write:
        for split, entry in splits.items():
            digest = schema.SplitDigest(entry["maps"], height, width)
            for span in spans(entry["maps"], BLOCK_MAPS):
                indices = np.arange(*span)
                block = Block.of(_read_or_make(dataset, recipes, split, indices, chosen[split]))
                digest.update(block.digests)
                write(split, block)
                done += len(indices)
                yield done, total
            if digest.hexdigest() != dataset.splits[split]["digest"]:
                version = manifest["generator"]["version"]
                raise DatasetError(
                    f"Split {split!r} of {dataset.path} cannot be repaired: made anew it has digest "
                    f"{digest.hexdigest()}, and its manifest names {dataset.splits[split]['digest']}. "
                    f"It was made by benchnav {version}; install that version, or make the file again."
                )


def _read_or_make(
    dataset: TerrainDataset, recipes: list[Recipe], split: str, indices: np.ndarray, chosen: np.ndarray
) -> Maps:
    fresh = np.isin(indices, chosen)
    kept = indices[~fresh]
    pieces = [(kept, dataset.read(split, kept.tolist()))] if len(kept) else []
    for first, part in _parts(dataset, split):
        own = indices[fresh & (indices >= first) & (indices < first + part["maps"])]
        if len(own):
            recipe = recipes[part["recipe"]]
            pieces.append((own, generate(recipe, part["split"], own - first + part["first"])))
    order = np.argsort(np.concatenate([numbers for numbers, _ in pieces]))
    return {name: np.concatenate([maps[name] for _, maps in pieces])[order] for name in schema.FIELDS}


def _parts(dataset: TerrainDataset, split: str) -> Iterator[tuple[int, dict[str, Any]]]:
    first = 0
    for part in dataset.splits[split]["parts"]:
        yield first, part
        first += part["maps"]


def _lost(dataset: TerrainDataset, split: str, indices: np.ndarray) -> Iterator[str]:
    for first, part in _parts(dataset, split):
        own = indices[(indices >= first) & (indices < first + part["maps"])]
        if len(own) and "recipe" not in part:
            source = part.get("source", {}).get("file", "elsewhere")
            named = ", ".join(map(str, own[:10].tolist())) + (" …" if len(own) > 10 else "")
            yield f"maps {named} of {split} came from {source} and have no recipe: import them again"
