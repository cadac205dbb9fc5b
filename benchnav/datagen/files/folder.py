"""Datasets of many shards: a folder of files, and a manifest that says which maps lie in which."""

import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchnav.datagen import schema
from benchnav.datagen.files.hdf5 import manifest_of
from benchnav.datagen.files.reader import FOLDER_MANIFEST, open_file
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.files import write_text

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
    write_text(folder / FOLDER_MANIFEST, schema.seal(manifest))


def take_place(partial: Path, out: Path) -> None:
    """Moves a whole folder to where it is to be, in the place of one that is there.

    Args:
        partial: the folder, beside `out`.
        out: where it is to be.
    """
    dropped = _dropped(out)
    shutil.rmtree(dropped, ignore_errors=True)
    if out.exists():
        out.rename(dropped)
    partial.rename(out)
    shutil.rmtree(dropped, ignore_errors=True)


def restore(out: Path) -> None:
    """Gives a folder its name back which a run had taken away, that was killed before it put a new one there."""
    if _dropped(out).exists() and not out.exists():
        with suppress(FileNotFoundError):  # another share of it was quicker
            _dropped(out).rename(out)


def _dropped(out: Path) -> Path:
    return out.with_name(f".{out.name}.dropped")
