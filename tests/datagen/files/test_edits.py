"""Datasets edited at random: every command and reader gives one line, or what was
stored.
"""

import json
import random
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from benchnav.core.errors import BenchnavError
from benchnav.core.store import seal
from benchnav.datagen.files.create import create
from benchnav.datagen.files.maps import TerrainMaps
from benchnav.datagen.files.reader import TerrainDataset
from tests.commands import call
from tests.factories import tiny_dataset, tiny_recipe

EDITS = pytest.mark.parametrize(
    "seeds",
    [range(30), pytest.param(range(30, 350), marks=pytest.mark.slow)],
    ids=["30", "320"],
)
VALUES: list[Any] = [None, -1, 0, 3, 10**30, 0.5, "", "x", "../x.h5", [], {}, True]


def edit_bytes(path: Path, rng: random.Random) -> None:
    """Changes, cuts out or adds some bytes of a file of the dataset."""
    file = rng.choice(sorted(path.iterdir())) if path.is_dir() else path
    content = bytearray(file.read_bytes())
    place, count = rng.randrange(len(content)), rng.choice([1, 4, 64])
    new = rng.randbytes(rng.choice([0, count, count, count, 2 * count]))
    content[place : place + count] = new
    file.write_bytes(content)


def edit_manifest(path: Path, rng: random.Random) -> None:
    """Changes, removes or adds a value anywhere in the manifest, which is sealed anew."""
    is_folder = path.is_dir()
    text = (path / "manifest.json").read_text() if is_folder else ""
    if not is_folder:
        with h5py.File(path) as file:
            text = file["manifest"][()]
    manifest = json.loads(text)
    del manifest["manifest_digest"]
    place: Any = manifest
    while True:
        key = rng.choice(list(place) if isinstance(place, dict) else range(len(place)))
        if (
            not isinstance(place[key], dict | list)
            or not place[key]
            or rng.random() < 0.2
        ):
            break
        place = place[key]
    if rng.random() < 0.3:
        del place[key]
    else:
        place[key] = rng.choice(VALUES)
    sealed = seal(manifest)
    if is_folder:
        (path / "manifest.json").write_text(sealed)
        return
    with h5py.File(path, "r+") as file:
        del file["manifest"]
        file["manifest"] = sealed


def edit_array(path: Path, rng: random.Random) -> None:
    """Changes an attribute, renames, removes or reshapes an array."""
    with h5py.File(
        rng.choice(sorted(path.glob("*.h5"))) if path.is_dir() else path, "r+"
    ) as file:
        split = rng.choice(
            [name for name in ("train", "valid", "test/hg") if name in file] or ["test"]
        )
        if split == "test":
            split = f"test/{next(iter(file['test']))}"
        name = rng.choice(list(file[split]))
        how = rng.choice(["attribute", "remove", "rename", "shorten", "kind"])
        stored = file[split][name]
        if how == "attribute":
            stored.attrs[rng.choice(["unit", "meaning", "new"])] = rng.choice(
                ["", 3, "x"]
            )
            return
        values = stored[:]
        del file[split][name]
        if how == "rename":
            file[split]["other"] = values
        elif how == "shorten":
            file[split][name] = values[:-1]
        elif how == "kind":
            file[split][name] = values.astype(np.float64)


def content(path: Path) -> dict[str, np.ndarray]:
    """What readers give of a dataset."""
    dataset = TerrainDataset(path)
    read = {f"{s}/{n}": a for s in dataset.splits for n, a in dataset.read(s).items()}
    for split in dataset.splits:
        dataset.terrain(split)
        for name, values in TerrainMaps(path, split, ("rgb",))[0].items():
            np.testing.assert_array_equal(values, read[f"{split}/{name}"][0])
    return read


@EDITS
@pytest.mark.parametrize("edit", [edit_bytes, edit_manifest, edit_array])
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_an_edited_dataset_is_one_line_or_what_was_stored(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    kind: str,
    edit: Callable[[Path, random.Random], None],
    seeds: range,
) -> None:
    sound, edited = tmp_path / "sound", tmp_path / "edited"
    if kind == "file":
        sound, edited = tiny_dataset(tmp_path / "sound.h5"), tmp_path / "edited.h5"
    else:
        for _ in create(tiny_recipe(), sound, shard_cells=3 * 32 * 32):
            pass
    expected = content(sound)
    for seed in seeds[::6]:  # six ways share them
        if edited.is_dir():
            shutil.rmtree(edited)
        (shutil.copytree if kind == "folder" else shutil.copy)(sound, edited)
        edit(edited, random.Random(seed))
        with suppress(BenchnavError):
            given = content(edited)
            for name in set(given) & set(expected):
                np.testing.assert_array_equal(
                    given[name], expected[name], err_msg=f"seed {seed}"
                )
        commands = {"show": [], "validate": []}
        if seed % 4 == 0:  # slower than the others
            commands["preview"] = ["--maps", "[0]", "--out", str(tmp_path / "p.png")]
        for command, options in commands.items():
            status = call("datagen", command, edited, *options)
            said = capsys.readouterr().err
            allowed = (0, 1, 2) if command == "validate" else (0, 2)
            assert status in allowed, seed
            assert said.count("\n") == (status == 2), (seed, said)
