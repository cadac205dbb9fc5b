"""Shards: some maps of a split, in a file that is a dataset by itself.

A shard is a pure function of the recipe and of which maps it holds, so that any process on any machine may
make it, and one that is lost is made anew.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import benchnav
from benchnav.core.errors import DatasetError
from benchnav.core.store import replacing
from benchnav.datagen.files.hdf5 import pack
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.synth.generate import generate

SHARD_CELLS = 2**20


@dataclass(frozen=True, order=True, kw_only=True)
class ShardFile:
    """Consecutive maps of a recipe's split.

    Args:
        split: name of the split.
        first: its first map.
        stop: one past its last.
    """

    split: str
    first: int
    stop: int

    @property
    def maps(self) -> int:
        """Number of maps."""
        return self.stop - self.first

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.split.replace('/', '+')}-{self.first:08d}-{self.stop:08d}.h5"


def cut(recipe: Recipe, cells: int = SHARD_CELLS) -> list[ShardFile]:
    """Cuts a recipe into shards of about so many cells, in the order of splits and maps."""
    size = max(1, cells // (recipe.height * recipe.width))
    return [
        ShardFile(split=split, first=first, stop=min(first + size, spec.maps))
        for split, spec in recipe.splits.items()
        for first in range(0, spec.maps, size)
    ]


def make(recipe: Recipe, shard: ShardFile) -> bytes:
    """Makes a shard.

    Returns:
        What its file holds.

    Raises:
        ConfigError: the recipe cannot be met.
    """
    maps = generate(recipe, shard.split, np.arange(shard.first, shard.stop))
    return pack(recipe.id, recipe, shard.split, _entry(recipe, shard), maps)


def write(path: Path, content: bytes) -> None:
    """Puts a shard in its place, whole or not at all."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def is_there(path: Path, recipe: Recipe, shard: ShardFile) -> bool:
    """Tells whether a file is this shard of this recipe, made by this version."""
    if not path.exists():
        return False
    try:
        manifest = TerrainDataset(path).manifest
    except DatasetError:
        return False
    entry = {
        name: value for name, value in manifest["splits"].get(shard.split, {}).items() if name != "digest"
    }
    own = [recipe.to_dict()], {"package": "benchnav", "version": benchnav.__version__}
    return (manifest["recipes"], manifest["generator"]) == own and entry == _entry(recipe, shard)


def _entry(recipe: Recipe, shard: ShardFile) -> dict[str, Any]:
    part = {"maps": shard.maps, "recipe": 0, "split": shard.split, "first": shard.first}
    return {"scenario": recipe.splits[shard.split].scenario, "maps": shard.maps, "parts": [part]}
