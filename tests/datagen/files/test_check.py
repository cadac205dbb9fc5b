from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from benchnav.core.errors import DatasetError
from benchnav.datagen import schema
from benchnav.datagen.files.check import Fault, find_faults, summarise
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from tests.factories import tiny_dataset, tiny_recipe

CELLS = 32 * 32


def content(path: Path) -> dict[str, np.ndarray]:
    dataset = TerrainDataset(path)
    arrays = {f"{s}/{n}": a for s in dataset.splits for n, a in dataset.read(s).items()}
    return arrays | {s: dataset.entry_digests(s) for s in dataset.splits}


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    return all(
        np.array_equal(one[name], other[name], equal_nan=one[name].dtype.kind == "f")
        for name in one
    )


def flip(path: Path, split: str, field: str, index: int) -> None:
    with h5py.File(path, "r") as file:
        place = file[split][field].id.get_chunk_info(index)
    raw = bytearray(path.read_bytes())
    raw[place.byte_offset + place.size // 2] ^= 4
    path.write_bytes(raw)


def sharded(path: Path) -> Path:
    for _ in create(tiny_recipe(), path, shard_cells=3 * CELLS):
        pass
    return path


def test_a_flipped_byte_is_named_by_map_and_field(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    assert find_faults(path) == []
    flip(path, "train", "slope_deg", 5)
    flip(path, "test/hg", "rgb", 1)
    assert sorted(find_faults(path)) == [
        Fault("test/hg", 1, "rgb", "is damaged"),
        Fault("train", 5, "slope_deg", "is damaged"),
    ]
    with pytest.raises(DatasetError, match=r"slope_deg.*validate"):
        TerrainDataset(path).read("train")
    sound = [i for i in range(8) if i != 5]
    assert len(TerrainDataset(path).read("train", sound)["slope_deg"]) == 7


def test_changed_values_with_sound_checksums_are_named_by_map_and_field(
    tmp_path: Path,
) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    with h5py.File(path, "r+") as file:
        file["test/hs/traversability"][1, 2, 3] = 1.5
        file["train/elevation_m"][2, 0, 0] += 2.0**-13
        file["train/goal_m"][4] = [1, 1]
        # as of a cell not observed: in range
        file["valid/traversability"][0, 5, 5] = np.nan
    found = {str(fault) for fault in find_faults(path)}
    assert found == {
        "test/hs: map 1: field 'traversability' is out of range",
        "test/hs: map 1: field 'traversability' does not match its digest",
        "train: map 2: field 'elevation_m' does not match its digest",
        "train: map 4: field 'goal_m' does not match its digest",
        "valid: map 0: field 'traversability' does not match its digest",
    }


def test_a_missing_and_a_foreign_array_are_named(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    with h5py.File(path, "r+") as file:
        del file["valid/class_id"], file["train/environment"]
        file["train/environment"] = np.zeros(3)
    problems = {(f.split, f.map, f.field) for f in find_faults(path)}
    assert problems == {("valid", -1, "class_id"), ("train", -1, "environment")}


def test_damaged_digests_beside_sound_maps_are_told_from_damaged_maps(
    tmp_path: Path,
) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    with h5py.File(path, "r+") as file:
        file["train"][schema.ENTRY_DIGESTS][3, 2, 0] ^= 1
    assert [str(f) for f in find_faults(path)] == [
        "train: map 3: field 'entry_digests' does not match the map"
    ]


def test_maps_and_digests_changed_together_are_found(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    with h5py.File(path, "r+") as file:
        file["train/class_id"][3] = 0
        changed = {name: file["train"][name][()] for name in schema.FIELDS}
        file["train"][schema.ENTRY_DIGESTS][...] = schema.entry_digests(
            changed, schema.FIELDS
        )
    assert [f.map for f in find_faults(path)] == [-1]


@pytest.mark.parametrize("seed", range(3))
def test_every_random_flip_in_data_is_found(tmp_path: Path, seed: int) -> None:
    recipe = replace(tiny_recipe(train=3, valid=1, test_std=1, test_hg=1, test_hs=1))
    path = tiny_dataset(tmp_path / "d.h5", recipe)
    sound, whole = content(path), path.read_bytes()
    generator = np.random.default_rng(seed)
    found = 0
    for at in generator.integers(len(whole), size=16):
        raw = bytearray(whole)
        raw[at] ^= 1 << int(generator.integers(8))
        path.write_bytes(raw)
        try:
            faults = bool(find_faults(path))
        except DatasetError:  # the manifest, or the structure around it
            faults = True
        found += faults
        # Unused room between arrays is no data: a flip there changes nothing.
        assert faults or same(content(path), sound)
    assert found > 10


def test_damage_of_two_kinds_in_neighbouring_maps_is_named(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    with h5py.File(path, "r+") as file:
        file["train/class_id"][5] = 1
    flip(path, "train", "rgb", 3)
    assert sorted(find_faults(path)) == [
        Fault("train", 3, "rgb", "is damaged"),
        Fault("train", 5, "class_id", "does not match its digest"),
    ]


def test_damaged_shards_are_named_and_they_alone_made_anew(tmp_path: Path) -> None:
    path = sharded(tmp_path / "d")
    assert find_faults(path) == []
    before, digest = content(path), TerrainDataset(path).digest
    damaged, gone, rest = (
        "train-00000003-00000006.h5",
        "test+hs-00000000-00000002.h5",
        sorted(path.glob("*.h5")),
    )
    flip(path / damaged, "train", "rgb", 1)
    (path / gone).unlink()
    assert find_faults(path) == [
        Fault("train", 4, "rgb", "is damaged", damaged),
        Fault("test/hs", -1, "", "is missing or cannot be opened", gone),
    ]
    assert (
        list(summarise(find_faults(path)))[1]
        == f"train: map 4: field 'rgb' is damaged ({damaged})"
    )
    (path / damaged).unlink()
    kept = {
        file: file.stat().st_mtime_ns
        for file in rest
        if file.name not in (damaged, gone)
    }
    sharded(path)
    assert find_faults(path) == []
    assert TerrainDataset(path).digest == digest
    assert same(content(path), before)
    assert all(file.stat().st_mtime_ns == when for file, when in kept.items())


def test_a_cell_without_a_class_is_a_fault_where_none_was_said_to_be(
    tmp_path: Path,
) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    with h5py.File(path, "r+") as file:
        file["train/class_id"][5, 2, 3] = schema.UNLABELLED
    assert Fault("train", 5, "class_id", "is out of range") in find_faults(path)
