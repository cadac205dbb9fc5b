"""Datasets of many shards: a folder of files, and a manifest that says which maps lie in which."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchnav.core.store import seal, write_text
from benchnav.datagen import schema
from benchnav.datagen.files.hdf5 import manifest_of
from benchnav.datagen.files.reader import FOLDER_MANIFEST, open_file
from benchnav.datagen.recipe.recipe import Recipe

FORMAT_VERSION = "1.2"  # at least


@dataclass(frozen=True, kw_only=True)
class Contents:
    """What a dataset is to hold, and the files that hold it.

    Args:
        id: name and version of the dataset.
        recipes: what the splits' parts refer to by number.
        splits: by name, the manifest's entry of each split without its digest.
        files: by split the files that hold its maps, in their order, each under the split's name.
        fields: what every map has.
    """

    id: str
    recipes: Sequence[Recipe]
    splits: Mapping[str, Mapping[str, Any]]
    files: Mapping[str, Sequence[Path]]
    fields: Mapping[str, schema.Field] = field(default_factory=lambda: schema.FIELDS)


def whole(recipe: Recipe, files: Mapping[str, Sequence[Path]]) -> Contents:
    """All maps of a recipe, by split the files that hold them."""
    splits = {
        name: {
            "scenario": spec.scenario,
            "maps": spec.maps,
            "parts": [{"maps": spec.maps, "recipe": 0, "split": name, "first": 0}],
        }
        for name, spec in recipe.splits.items()
    }
    return Contents(id=recipe.id, recipes=[recipe], splits=splits, files=files)


def write_manifest(folder: Path, contents: Contents) -> None:
    """Makes a dataset of files that lie in a folder.

    Args:
        folder: where they lie.
        contents: what they hold.
    """
    height, width = contents.recipes[0].grid.shape
    splits: dict[str, Any] = {}
    shards: dict[str, list[dict[str, Any]]] = {}
    for name, entry in contents.splits.items():
        digest, shards[name] = schema.SplitDigest(entry["maps"], height, width, contents.fields), []
        for path in contents.files[name]:
            with open_file(path) as file:
                digests = file[name][schema.ENTRY_DIGESTS][:]
            digest.update(digests)
            shards[name].append({"file": path.name, "maps": len(digests)})
        splits[name] = {**entry, "digest": digest.hexdigest()}
    manifest = manifest_of(contents.id, contents.recipes, splits, contents.fields)
    manifest |= {"format_version": max(manifest["format_version"], FORMAT_VERSION), "shards": shards}
    write_text(folder / FOLDER_MANIFEST, seal(manifest))
